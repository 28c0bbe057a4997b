"""The table of hard inputs of vector search: ours holds, and the naive formula fails on the same input."""

import numpy as np
import pytest

from indexes.kinds.checks import check_unit
from retrieval.lab.hard_cases.vectors import hard_cases, refused

KERNELS = ("unit vectors", "top k", "inner products", "recall", "halves")


@pytest.fixture(scope="module")
def rows():
    return hard_cases()


@pytest.mark.parametrize("kernel", KERNELS)
def test_what_must_hold_does_and_the_naive_formula_fails(rows, kernel):
    of_kernel = [row for row in rows if row.kernel == kernel]
    assert of_kernel
    assert [f"{row.case}: {row.ours}" for row in of_kernel if not row.holds] == []
    assert [f"{row.case}: {row.naive}" for row in of_kernel if row.naive_holds] == []


def test_every_row_says_all_of_it_and_comes_once(rows):
    assert {row.kernel for row in rows} == set(KERNELS)
    assert len({(row.kernel, row.case) for row in rows}) == len(rows)
    assert all(row.case and row.must_hold and row.naive and row.ours for row in rows)


def test_what_is_accepted_does_not_count_as_refused():
    unit = np.ones((1, 1), np.float32)
    assert refused(lambda: check_unit(unit)) == ("accepted: [[1.]]", False)
    said, names_it = refused(lambda: check_unit(unit * np.nan), "row '7'")
    assert said.startswith("refused: row '0'")
    assert not names_it
    with pytest.raises(ZeroDivisionError):
        refused(lambda: 1 / 0)
