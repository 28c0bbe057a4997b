"""The page and the table of a query: self-contained, safe for all names, and robust to missing photos."""

import base64
import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from _touch_retrieval.files import file_digest
from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.posterior import Posterior
from retrieval.report.query import query_page
from retrieval.report.terminal import print_table
from retrieval.search.answer import Match, QueryResult, verdict_sentence
from retrieval.search.searcher import Searcher
from tests.pages import HtmlPage

SCRIPT = "<script>alert(1)</script>"
POSTERIOR = dataclasses.asdict(Posterior(slope=0.75, offset=-1.25, dependence=0.5, tests=9)) | {
    "none_prior": 0.5,
    "grasps": 2,
    "objects": 500,
    "scored_objects": 80,
    "unscored_probability": 0.125,
}


def result_of(*matches, catalogue=Path("catalog"), touches=(("a.png", "b.png"),), **fields):
    """Return a result with these (object, logit, probability, photo, metadata)."""
    index = {"path": "index", "generation": "gen-000001", "kind": "flat", "photos": 1, "objects": 1, "scored": 1}
    index |= {"catalogue": str(catalogue), "model": "m.safetensors", "trained_on": "nothing"}
    known = {"verdict": "match", "none_probability": 0.2, "posterior": POSTERIOR} | fields
    if "grasps" not in known:
        known["grasps"] = ["contact"] * len(touches)
    present = 1 - (known["none_probability"] or 0)
    ranked = [
        Match(
            rank,
            *scores,
            photo,
            file_digest(catalogue / photo) if (catalogue / photo).is_file() else "",
            metadata,
            catalogue / photo,
            None,
            scores[2] and scores[2] / present,
        )
        for rank, (*scores, photo, metadata) in enumerate(matches, start=1)
    ]
    touches = [list(touch) for touch in touches]
    return QueryResult(touches=touches, index=index, timing_ms={"decode": 1.0}, results=ranked, **known)


def page_of(*matches, catalogue=Path("nowhere"), **fields):
    return HtmlPage(query_page(result_of(*matches, catalogue=catalogue, **fields), catalogue))


def marked(page):
    return [tag for tag in page.all("div") if "marked" in tag.get("class", "").split()]


ONE = ("mug", 1.5, 0.8, "mug/1.jpg", {})


@pytest.fixture(scope="module")
def answer(catalogue, model, two_grasps, tmp_path_factory):
    """A real result over a catalogue with metadata, and that catalogue; one photo is missing, one is damaged."""
    folder = tmp_path_factory.mktemp("report")
    own = shutil.copytree(catalogue, folder / "catalog")
    lines = [json.dumps({"object_id": path.name, "shelf": "B4"}) for path in own.iterdir()]
    (own / "metadata.jsonl").write_text("\n".join(lines))
    build_index(own, load_checkpoint(model), folder / "index")
    result = Searcher.open(folder / "index").query(two_grasps, top=5)
    (own / result.results[0].photo).unlink()
    broken = own / result.results[1].photo
    broken.write_bytes(broken.read_bytes()[:300])
    return result, own


def test_the_page_is_self_contained_shows_every_match_and_leaves_missing_photos_blank(answer):
    result, catalogue = answer
    source = query_page(result, catalogue)
    page = HtmlPage(source)
    assert not [word for word in ("http:", "https:", "file:", "//cdn", "@import", "url(") if word in source]
    assert {tag for tag, _ in page.tags}.isdisjoint({"link", "iframe", "object"})
    assert all(image["src"].startswith("data:image/jpeg;base64,") and image["alt"] for image in page.all("img"))
    assert (len(page.all("img")), page.text.count("no picture")) == (4 + 3, 2)
    for match in result.results:
        for words in (f"{match.rank}. {match.object_id}", f"{match.logit:+.2f}", match.photo, "shelf: B4"):
            assert words in page.text
    assert "Grasps: 2. Catalogue: 24 photos, 8 objects." in page.text
    assert "account for the correlation of several grasps of one object" in page.text


def test_the_pictures_are_thumbnails_with_unchanged_shape_and_colours(tmp_path):
    picture = np.zeros((300, 1200, 3), np.uint8)
    picture[..., 2] = 200  # red, in OpenCV's order
    cv2.imwrite(str(tmp_path / "wide.png"), picture)
    page = page_of(("mug", 1.5, 0.8, "wide.png", {}), catalogue=tmp_path)
    data = base64.b64decode(page.all("img")[0]["src"].split(",")[1])
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape == (80, 320, 3)
    np.testing.assert_allclose(decoded.mean(axis=(0, 1)), (0, 0, 200), atol=4)  # loss of JPEG


def test_names_and_metadata_cannot_inject_markup():
    page = page_of((SCRIPT, 1.5, 0.8, SCRIPT, {SCRIPT: SCRIPT}), touches=[[SCRIPT, "b.png"]])
    assert page.all("script") == []
    assert page.text.count(SCRIPT) == 5


@pytest.mark.parametrize(
    ("probability", "words"),
    [(1.0, "over 99.9 %"), (0.99934, "over 99.9 %"), (0.5, "50.0 %"), (0.013, "1.3 %"), (1e-9, "under 0.1 %")],
)
def test_a_probability_is_never_shown_as_certain(probability, words):
    text = page_of(("mug", 1.5, probability, "1.jpg", {})).text
    assert words in text
    assert "100.0 %" not in text


UNCLEAR, CLEAR = ("mug", 1.5, 0.04, "mug/1.jpg", {}), ("mug", 1.5, 0.08, "mug/1.jpg", {})


@pytest.mark.parametrize(
    ("match", "advice"),
    [
        (UNCLEAR, "The ranking is not clear. Reference touches of its first objects"),
        (CLEAR, "The ranking is clear. Reference touches of mug, or further grasps"),
    ],
)
def test_the_verdict_none_of_these_marks_no_card_and_gives_fitting_advice(match, advice):
    fields = {"verdict": "none of these", "none_probability": 0.9}
    result, page = result_of(match, **fields), page_of(match, **fields)
    assert advice in result.advice
    assert QueryResult.from_dict(result.to_dict()) == result
    assert verdict_sentence(result).removeprefix("none") in page.text
    assert "1. mug" in page.text
    assert not marked(page)


def test_the_verdict_match_marks_the_first_card_and_gives_no_advice():
    page = page_of(ONE, ("cup", 0.5, 0.1, "cup/1.jpg", {}))
    assert "Match: mug, probability 0.80; none of these: 0.20." in page.text
    assert len(marked(page)) == 1
    assert result_of(ONE).advice is None


def test_a_model_without_calibration_shows_no_probability():
    one = ("mug", 1.5, None, "1.jpg", {})
    page = page_of(one, verdict="uncalibrated", none_probability=None, posterior=None)
    assert "Uncalibrated: mug ranks first" in page.text
    assert "not calibrated" in page.text
    assert "%" not in page.text


def test_a_piped_table_is_plain_escaped_and_uncut(capsys):
    """In a pipe, rich would fold names at 80 columns and draw frames."""
    long = "slab-knurl-with-a-long-name-20000-0001\x1b"
    print_table(result_of((long, 1.5, 0.72, f"{long}/1.jpg", {}), ("mug", -0.25, 0.08, "a very/" + "deep/" * 20, {})))
    shown = long.replace("\x1b", "\\x1b")
    assert capsys.readouterr().out == (
        f"rank  {'object':<42}  probability  if present  logit  photo\n"
        f"   1  {shown}        0.720       0.900  +1.50  {shown}/1.jpg\n"
        f"   2  {'mug':<42}        0.080       0.100  -0.25  a very/{'deep/' * 20}\n"
        f"   -  {'none of these':<42}        0.200\n"
    )
