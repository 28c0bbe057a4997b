"""The memory of an import grows only with the names of its rows: `python -m benchmarks.importers_memory`."""

import re
from pathlib import Path

import pytest

from benchmarks.importers_memory import MAX_KB, WIDE, growth_kb, peak_mb
from robot.importers import IMPORTERS

FEW, MANY = 1000, 6000
SPREAD_MB = 4
"""Difference between two runs of the same rows."""
CODEC = "lerobot"
"""Its video decoder fills buffers over about ten thousand rows: only the command covers it."""


def test_rows_are_drawn_for_every_importer():
    assert {re.sub(r" \(.*", "", name) for name in WIDE} == set(IMPORTERS)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("name", [name for name in WIDE if name != CODEC])
def test_memory_grows_only_by_the_names_of_rows(name):
    peaks = {rows: peak_mb(name, rows) for rows in (FEW, MANY)}
    spread_kb = 1000 * SPREAD_MB / (MANY - FEW)
    for what, limit_kb in MAX_KB.items():
        assert growth_kb(peaks, what) < limit_kb + spread_kb, peaks
