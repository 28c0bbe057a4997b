"""Touches that are enrolled in an index: opened searchers find them at once, and no writer loses them."""

import pytest

import retrieval
from retrieval.indexing.build import build_index
from retrieval.search.searcher import Searcher
from tests.reference_model import NAMES, write_reference_model


@pytest.fixture
def index(catalogue, tmp_path):
    build_index(catalogue, write_reference_model(tmp_path / "model.safetensors"), tmp_path / "index", quiet=True)
    return tmp_path / "index"


def test_an_opened_searcher_finds_an_object_that_was_enrolled_in_the_meantime(index, touches):
    with Searcher.open(index) as searcher:
        before = searcher.query(touches[NAMES[0]][0], top=99)
        assert retrieval.enrol(index, "a cup", touches[NAMES[0]][0], opening_mm=30) == ("a cup", 1, 1)
        after = searcher.query(touches[NAMES[0]][0], top=99)
        assert len(after.results) == len(before.results) + 1 == after.index["objects"]
        cup = next(match for match in after.results if match.object_id == "a cup")
        assert cup.photo.startswith("enrolled/a%20cup/")
        assert cup.photo_path.is_file()
        assert cup.reference.cosine == pytest.approx(1, abs=1e-3)
        assert retrieval.remove_enrolled(index, "a cup") == ("a cup", 1)
        assert searcher.query(touches[NAMES[0]][0], top=99).results == before.results
        assert not cup.photo_path.exists()
