"""Verdicts of the shipped checkpoint: no-contact frames, black images, noise and photos match no object."""

import json
import shutil
from functools import partial

import numpy as np
import pytest
from PIL import Image

from retrieval.commands.main import main
from retrieval.data.dataset import load_grasps
from retrieval.model.checkpoint_info import read_checkpoint_info
from retrieval.model.shipped import SHIPPED, shipped_model
from retrieval.search.answer import EXIT_CODES, verdict_sentence
from retrieval.search.searcher import Searcher
from robot.collection import CollectSettings, collect
from robot.rig import load_rig

SEED = 41_000  # an object set of its own


@pytest.fixture(scope="module")
def grasps(tmp_path_factory):
    folder = tmp_path_factory.mktemp("verdicts") / "recording"
    collect(partial(load_rig, "sim", seed=SEED), folder, objects=4, seed=SEED, settings=CollectSettings(grasps=2))
    return load_grasps(folder)


@pytest.fixture(scope="module")
def index(grasps, tmp_path_factory):
    folder = tmp_path_factory.mktemp("verdicts")
    for number, grasp in enumerate(grasps):
        photo = folder / "catalog" / grasp.object_id / f"{number}{grasp.photo.suffix}"
        photo.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(grasp.photo, photo)
    assert main(["build-index", str(folder / "catalog"), "--out", str(folder / "index")]) == 0
    return folder / "index"


@pytest.fixture(scope="module")
def searcher(index):
    with Searcher.open(index) as opened:
        yield opened


NOISE = np.random.default_rng(1).integers(0, 256, (240, 320, 3), np.uint8)


def test_a_touch_is_scored_and_probabilities_add_up_to_one(searcher, grasps):
    results = {grasp.grasp_id: searcher.query(grasp.touches, top=99) for grasp in grasps}
    rejected = [name for name, result in results.items() if result.grasps != ["contact"]]
    assert len(rejected) <= 1, rejected  # a finger that hardly presses a smooth object may show no contact
    for result in (result for name, result in results.items() if name not in rejected):
        assert result.none_probability + sum(match.probability for match in result.results) == pytest.approx(1)
        best = result.results[0].probability
        assert result.verdict == ("match" if best > result.none_probability else "none of these")


def test_no_contact_frames_match_no_object(searcher, grasps):
    for grasp in grasps:
        result = searcher.query(grasp.backgrounds)
        assert (result.verdict, result.results, result.none_probability) == ("no contact", [], None)
        assert result.top is None
        assert verdict_sentence(result).startswith("no contact: the gels show no contact")


def test_a_grasp_with_a_foreign_image_and_one_without_contact_are_left_out_and_reported(searcher, grasps):
    touch, air = grasps[0].touches, grasps[0].backgrounds
    foreign = touch[0], np.zeros_like(NOISE)
    single, three = searcher.query(touch), searcher.query([touch, foreign, air])
    assert three.grasps == ["contact", "not a gel image", "no contact"]
    assert three.verdict == single.verdict
    assert [match.object_id for match in three.results] == [match.object_id for match in single.results]
    assert [match.logit for match in three.results] == pytest.approx(
        [match.logit for match in single.results], abs=1e-4
    )
    assert "left out (no contact: 3, not a gel image: 2)" in verdict_sentence(three)
    without = searcher.query([foreign, air])
    assert (without.verdict, without.results) == ("not a gel image", [])
    assert "an image of grasp 1 does not look like the gels" in verdict_sentence(without)


def test_contact_is_detected_by_comparison_with_a_no_contact_frame(searcher, grasps):
    grasp, later = grasps[0], grasps[1]
    assert searcher.query(grasp.touches, background=grasp.backgrounds).grasps == ["contact"]
    # No-contact frames of the same gels at another moment.
    assert searcher.query(later.backgrounds, background=grasp.backgrounds).grasps == ["no contact"]


def test_the_command_gives_the_verdict_as_exit_code_in_json_and_on_the_page(index, grasps, tmp_path, capsys):
    Image.fromarray(NOISE).save(tmp_path / "noise.png")
    for files, verdict in (
        (grasps[0].backgrounds, "no contact"),
        ([tmp_path / "noise.png"] * 2, "not a gel image"),
        ([grasps[0].photo] * 2, "not a gel image"),
    ):
        page = tmp_path / "page.html"
        words = ["query", "--gelsight", *map(str, files), "--index", str(index), "--json", "--html", str(page)]
        assert main(words) == EXIT_CODES[verdict]
        document = json.loads(capsys.readouterr().out)
        assert (document["verdict"], document["results"], document["none_probability"]) == (verdict, [], None)
        assert verdict in page.read_text("utf-8").lower()
        assert "Most likely" not in page.read_text("utf-8")


def test_the_probability_of_unscored_objects_is_estimated(index, grasps):
    """With two candidates, the result is close to exhaustive scoring, because the rest is estimated."""
    with Searcher.open(index) as searcher:
        exhaustive, with_two = (searcher.query(grasps[0].touches, candidates=count, top=2) for count in (99, 2))
        assert with_two.posterior["scored_objects"] < exhaustive.posterior["scored_objects"] == 4
        assert with_two.none_probability == pytest.approx(exhaustive.none_probability, abs=0.05)
        total = with_two.none_probability + sum(match.probability for match in with_two.results)
        assert total + with_two.posterior["unscored_probability"] == pytest.approx(1)


@pytest.mark.parametrize("fingers", SHIPPED)
def test_the_card_of_a_shipped_checkpoint_has_its_digest_and_the_error_rates_of_its_check(fingers):
    path = shipped_model(fingers)
    stored, card = read_checkpoint_info(path), path.with_suffix(".md").read_text("utf-8")
    assert f"\n# {path.name}\n" in card
    assert stored.provenance["data_digest"][:16] in card
    assert f"touches rejected as foreign {stored.gel_check.rates['touches_rejected_as_foreign']:.3f}" in card
