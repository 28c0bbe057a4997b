"""The page and the table of a query: self-contained, safe for all names, and robust to missing photos."""

import base64
import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint
from retrieval.model.posterior import Posterior
from retrieval.report.query import query_html
from retrieval.report.terminal import print_table
from retrieval.search.answer import Match, NearestReference, QueryResult, verdict_sentence
from retrieval.search.searcher import Searcher
from tests.pages import HtmlPage

SCRIPT = "<script>alert(1)</script>"
ESCAPED = "&lt;script&gt;alert(1)&lt;/script&gt;"


POSTERIOR = Posterior(slope=0.75, offset=-1.25, dependence=0.5, tests=9).to_dict() | {
    "none_prior": 0.5,
    "grasps": 1,
    "objects": 1,
    "scored_objects": 1,
    "unscored_probability": 0.0,
}


def synthetic_results(
    *matches, touches=(("a.png", "b.png"),), verdict="match", none=0.2, posterior=POSTERIOR, grasps=None, more=None
):
    """Return a result with these (object, logit, probability, photo, metadata)."""
    index = {"path": "index", "generation": "gen-000001", "kind": "flat", "photos": 1, "objects": 1, "scored": 1}
    index |= {"catalogue": "catalog", "model": "m.safetensors", "trained_on": "nothing"}
    ranked = [
        Match(rank, *match, Path("catalog", match[3]), None, match[2] and match[2] / (1 - none))
        for rank, match in enumerate(matches, start=1)
    ]
    return QueryResult(
        touches=[list(touch) for touch in touches],
        grasps=grasps or ["contact"] * len(touches),
        index=index,
        timing_ms={"decode": 1.0, "total": 2.0},
        verdict=verdict,
        none_probability=none,
        posterior=posterior,
        results=ranked,
        more_grasps=more,
    )


ONE = ("mug", 1.5, 0.8, "mug/1.jpg", {})


@pytest.fixture(scope="module")
def answer(catalogue, model, touch, tmp_path_factory):
    """A real result over a catalogue with metadata, and that catalogue."""
    folder = tmp_path_factory.mktemp("report")
    own = shutil.copytree(catalogue, folder / "catalog")
    lines = [json.dumps({"object_id": path.name, "shelf": "B4"}) for path in own.iterdir()]
    (own / "metadata.jsonl").write_text("\n".join(lines))
    build_index(own, load_checkpoint(model), folder / "index", quiet=True)
    return Searcher.open(folder / "index").query([touch, touch], top=5), own


def test_the_page_is_self_contained(answer):
    page = query_html(*answer)
    for word in ("http:", "https:", "file:", "//cdn", "@import", "url("):
        assert word not in page
    parsed = HtmlPage(page)
    assert {tag for tag, _ in parsed.tags}.isdisjoint({"script", "link", "iframe", "object", "a"})
    assert len(parsed.all("img")) == 4 + 5
    assert all(image["src"].startswith("data:image/jpeg;base64,") for image in parsed.all("img"))
    assert not [attributes for _, attributes in parsed.tags if {"href", "srcset", "action"} & set(attributes)]


def test_the_pictures_are_thumbnails_with_unchanged_shape_and_colours(tmp_path):
    picture = np.zeros((300, 1200, 3), np.uint8)
    picture[..., 2] = 200  # red, in OpenCV's order
    cv2.imwrite(str(tmp_path / "wide.png"), picture)
    page = HtmlPage(query_html(synthetic_results(("mug", 1.5, 0.8, "wide.png", {})), tmp_path))
    data = base64.b64decode(page.all("img")[0]["src"].split(",")[1])
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert decoded.shape == (80, 320, 3)
    np.testing.assert_allclose(decoded.mean(axis=(0, 1)), (0, 0, 200), atol=4)  # loss of JPEG


def test_the_page_shows_rank_probability_logit_photo_and_metadata(answer):
    result, catalogue = answer
    text = HtmlPage(query_html(result, catalogue)).text
    for match in result.results:
        for words in (f"{match.rank}. {match.object_id}", f"{match.logit:+.2f}", match.photo, "shelf: B4"):
            assert words in text
    assert "2 grasps against 24 photos of 8 objects" in text
    assert "account for the correlation of several grasps of one object" in text


def test_page_shows_formula_parameters_and_unscored_objects(tmp_path):
    posterior = POSTERIOR | {"grasps": 2, "objects": 500, "scored_objects": 80, "unscored_probability": 0.125}
    text = HtmlPage(query_html(synthetic_results(ONE, posterior=posterior), tmp_path)).text
    assert POSTERIOR["formula"] in text
    assert "slope 0.750, offset -1.250, dependence 0.500, grasps 2, none_prior 0.5, objects 500" in text
    assert "420 of 500 objects, with a total probability of 12.5 %" in text
    assert "add up to 1" in text


@pytest.mark.parametrize("place", ["object", "photo", "key", "value", "touch"])
def test_names_and_metadata_cannot_inject_markup(place, tmp_path):
    parts = {name: SCRIPT if name == place else name for name in ("object", "photo", "key", "value", "touch")}
    match = (parts["object"], 1.5, 0.8, parts["photo"], {parts["key"]: parts["value"]})
    page = query_html(synthetic_results(match, touches=[[parts["touch"], "b.png"]]), tmp_path)
    assert "<script" not in page
    assert (SCRIPT.split("/")[-1] if place == "touch" else SCRIPT) in HtmlPage(page).text


def test_a_missing_or_broken_photo_leaves_a_blank(answer, tmp_path):
    result, catalogue = answer
    own = shutil.copytree(catalogue, tmp_path / "catalog")
    (own / result.results[0].photo).unlink()
    broken = own / result.results[1].photo
    broken.write_bytes(broken.read_bytes()[:300])
    page = HtmlPage(query_html(result, own))
    assert len(page.all("img")) == 4 + 3
    assert page.text.count("no picture") == 2
    assert result.results[0].object_id in page.text


@pytest.mark.parametrize(
    ("probability", "words"),
    [(1.0, "over 99.9 %"), (0.99934, "over 99.9 %"), (0.5, "50.0 %"), (0.013, "1.3 %"), (1e-9, "under 0.1 %")],
)
def test_a_probability_is_never_shown_as_certain(probability, words, tmp_path):
    text = HtmlPage(query_html(synthetic_results(("mug", 1.5, probability, "1.jpg", {})), tmp_path)).text
    assert words in text
    assert "100.0 %" not in text


def test_the_page_states_the_verdict(tmp_path):
    accepted = HtmlPage(query_html(synthetic_results(ONE), tmp_path))
    assert "Most likely mug, probability 80.0 %; none of these: 20.0 %." in accepted.text
    assert answer_cards(accepted)
    one = ("mug", 1.5, 0.08, "mug/1.jpg", {})
    rejected = HtmlPage(query_html(synthetic_results(one, verdict="none of these", none=0.9), tmp_path))
    assert "None of these, most likely: the catalogue lacks the object with probability 90.0 %." in rejected.text
    assert "If it contains the object, this is mug with probability 80.0 %." in rejected.text
    assert "Reference touches of mug would help." in rejected.text
    assert "80.0 % if present" in rejected.text
    assert "Most likely" not in rejected.text
    assert "1. mug" in rejected.text
    assert not answer_cards(rejected)


UNCLEAR = ("mug", 1.5, 0.04, "mug/1.jpg", {})
CLEAR_PROBABILITY = ("mug", 1.5, 0.08, "mug/1.jpg", {})


@pytest.mark.parametrize(
    ("match", "grasps", "more", "advice"),
    [
        (UNCLEAR, 1, None, "The ranking is not clear. Reference touches of its first objects would help."),
        (
            CLEAR_PROBABILITY,
            1,
            None,
            "The ranking is clear, but more grasps would hardly change the verdict. Reference touches of mug",
        ),
        (CLEAR_PROBABILITY, 1, 1, 'Another grasp would help: 1 more like this one would make the verdict "match".'),
        (CLEAR_PROBABILITY, 2, 3, 'Another grasp would help: 3 more like these would make the verdict "match".'),
    ],
)
def test_the_advice_fits_the_verdict(match, grasps, more, advice, tmp_path):
    touches = [["a.png", "b.png"]] * grasps
    result = synthetic_results(match, touches=touches, verdict="none of these", none=0.9, more=more)
    assert result.advice.startswith(advice)
    assert result.to_dict()["advice"] == result.advice
    assert QueryResult.from_dict(result.to_dict()) == result
    assert advice in HtmlPage(query_html(result, tmp_path)).text
    assert verdict_sentence(result).endswith(result.advice)
    assert synthetic_results(ONE).advice is None


def test_the_advice_for_an_object_with_reference_touches_requests_more():
    result = synthetic_results(CLEAR_PROBABILITY, verdict="none of these", none=0.9)
    match = dataclasses.replace(result.top, reference=NearestReference(("mug/touch_0_a.png",), 0.9, 0.1))
    assert "More reference touches of mug would help." in dataclasses.replace(result, results=[match]).advice


def answer_cards(page):
    """Return the cards that are marked as the answer."""
    return [tag for tag in page.all("div") if "first" in tag.get("class", "").split()]


@pytest.mark.parametrize(
    ("verdict", "words"),
    [
        ("no contact", "No contact. The gel images show no contact"),
        ("not a gel image", "Not a gel image. The marked images do not look like gel images"),
    ],
)
def test_without_a_ranking_the_page_gives_the_reason_and_marks_the_grasps(verdict, words, tmp_path):
    touches = [["a.png", "b.png"], ["c.png", "d.png"]]
    checks = [verdict, "contact" if verdict == "not a gel image" else verdict]
    result = synthetic_results(touches=touches, verdict=verdict, none=None, posterior=None, grasps=checks)
    page = HtmlPage(query_html(result, tmp_path))
    assert words in page.text
    assert f"grasp 1: {verdict}, not scored" in page.text
    assert ("grasp 2: " in page.text) == (verdict == "no contact")
    assert "Most likely" not in page.text
    assert "Photos" not in page.text
    assert not answer_cards(page)


def test_a_model_without_calibration_shows_no_probability(tmp_path):
    result = synthetic_results(("mug", 1.5, None, "1.jpg", {}), verdict="uncalibrated", none=None, posterior=None)
    page = HtmlPage(query_html(result, tmp_path))
    assert "Most likely mug." in page.text
    assert "not calibrated" in page.text
    assert "none of these" not in page.text
    assert not [tag for tag in page.all("div") if tag.get("class") == "bar"]


# The table on a terminal ---------------------------------------------------------------------------------------


def test_names_in_the_table_are_escaped(answer, capsys):
    result, _ = answer
    match = dataclasses.replace(result.results[0], object_id="m\x1b[1m\n2", photo="\u202eg/1.jpg")
    print_table(dataclasses.replace(result, results=[match]))
    out = capsys.readouterr().out
    assert "m\\x1b[1m\\n2" in out
    assert "\\u202eg/1.jpg" in out


def test_the_table_has_a_line_for_each_object(answer, capsys):
    result, _ = answer
    print_table(result)
    out = capsys.readouterr().out
    for match in result.results:
        line = next(line for line in out.splitlines() if match.photo in line)
        assert match.object_id in line
        assert f"{match.probability:.3f}" in line
        assert f"{match.probability_if_present:.3f}" in line
    assert f"{result.none_probability:.3f}" in next(line for line in out.splitlines() if "none of these" in line)


def test_a_piped_table_is_plain_and_uncut(capsys):
    """In a pipe, rich would fold names at 80 columns and draw frames."""
    long = "slab-knurl-with-a-long-name-20000-00010"
    print_table(
        synthetic_results((long, 1.5, 0.72, f"{long}/1.jpg", {}), ("mug", -0.25, 0.08, "a very/" + "deep/" * 20, {}))
    )
    name = f"{'object':<39}"
    assert capsys.readouterr().out == (
        f"rank  {name}  probability  if present  logit  photo\n"
        f"   1  {long}        0.720       0.900  +1.50  {long}/1.jpg\n"
        f"   2  {'mug':<39}        0.080       0.100  -0.25  a very/{'deep/' * 20}\n"
        f"   -  {'none of these':<39}        0.200\n"
    )
