"""Verdicts of the shipped checkpoint: untouched gels, black images, noise and photos name no object, on any way in."""

import json
import shutil
from functools import partial

import numpy as np
import pytest
from PIL import Image

from retrieval.commands.main import main
from retrieval.data.dataset import load_grasps
from retrieval.model.checkpoint_info import read_checkpoint_info
from retrieval.search.defaults import SHIPPED, shipped_model
from retrieval.search.query.answer import EXIT_CODES, verdict_sentence
from retrieval.search.query.searcher import Searcher
from robot.collection import CollectSettings, collect
from robot.rig import load_rig

SEED = 41_000  # a world of its own


@pytest.fixture(scope="module")
def grasps(tmp_path_factory):
    folder = tmp_path_factory.mktemp("verdicts") / "recording"
    collect(partial(load_rig, "sim", seed=SEED), folder, objects=4, seed=SEED, settings=CollectSettings(grasps=2))
    return load_grasps(folder)


@pytest.fixture(scope="module")
def index(grasps, tmp_path_factory):
    folder = tmp_path_factory.mktemp("verdicts")
    for number, grasp in enumerate(grasps):
        shown = folder / "catalog" / grasp.object_id / f"{number}{grasp.photo.suffix}"
        shown.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(grasp.photo, shown)
    assert main(["build-index", str(folder / "catalog"), "--out", str(folder / "index")]) == 0
    return folder / "index"


@pytest.fixture(scope="module")
def searcher(index):
    with Searcher.open(index) as opened:
        yield opened


def picture(kind):
    rng = np.random.default_rng(1)
    samples = {
        "black": np.zeros((240, 320, 3)),
        "white": np.full((240, 320, 3), 255),
        "noise": rng.integers(0, 256, (240, 320, 3)),
    }
    return samples[kind].astype(np.uint8)


def test_a_touch_is_scored_and_probabilities_add_up_to_one(searcher, grasps):
    results = {grasp.grasp_id: searcher.query(grasp.touches, top=99) for grasp in grasps}
    refused = [name for name, result in results.items() if result.grasps != ["contact"]]
    assert len(refused) <= 1, refused  # a finger that hardly presses a smooth object may feel nothing
    for result in (result for name, result in results.items() if name not in refused):
        assert result.none_probability + sum(match.probability for match in result.results) == pytest.approx(1)
        best = result.results[0].probability
        assert result.verdict == ("match" if best > result.none_probability else "none of these")


def test_no_contact_frames_match_no_object(searcher, grasps):
    for grasp in grasps:
        result = searcher.query(grasp.backgrounds)
        assert (result.verdict, result.results, result.none_probability) == ("no contact", [], None)
        assert result.top is None
        assert verdict_sentence(result).startswith("no contact: the gels look untouched")


@pytest.mark.parametrize("kind", ["black", "white", "noise"])
def test_pictures_that_are_no_gel_images_name_nobody(searcher, kind):
    result = searcher.query([picture(kind)] * 2)
    assert (result.verdict, result.results, result.grasps) == ("not a gel image", [], ["not a gel image"])


def test_one_foreign_picture_among_good_grasps_refuses_them_all_and_is_named(searcher, grasps):
    good = grasps[0].touches
    result = searcher.query([good, (good[0], picture("black"))])
    assert (result.verdict, result.grasps) == ("not a gel image", ["contact", "not a gel image"])
    assert "grasp 2 does not look like a gel" in verdict_sentence(result)


def test_a_grasp_without_contact_is_left_out(searcher, grasps):
    grasp = grasps[0]
    alone, with_air = searcher.query(grasp.touches), searcher.query([grasp.touches, grasp.backgrounds])
    assert with_air.grasps == ["contact", "no contact"]
    assert [match.object_id for match in with_air.results] == [match.object_id for match in alone.results]
    assert [match.logit for match in with_air.results] == pytest.approx(
        [match.logit for match in alone.results], abs=1e-4
    )
    assert "left out: 2" in verdict_sentence(with_air)


def test_a_no_contact_frame_tells_contact_by_itself(searcher, grasps):
    grasp, later = grasps[0], grasps[1]
    assert searcher.query(grasp.touches, background=grasp.backgrounds).grasps == ["contact"]
    # The same gels, untouched, at another moment.
    assert searcher.query(later.backgrounds, background=grasp.backgrounds).grasps == ["no contact"]


def test_several_objects_at_once_have_each_their_own_verdict(searcher, grasps):
    results = searcher.query_many([grasps[0].touches, grasps[0].backgrounds, [picture("black")] * 2])
    assert [result.verdict for result in results][1:] == ["no contact", "not a gel image"]
    assert results[0].results


def test_the_command_says_the_verdict_by_its_exit_code_in_json_and_on_the_page(index, grasps, tmp_path, capsys):
    Image.fromarray(picture("black")).save(tmp_path / "black.png")
    black = [str(tmp_path / "black.png")] * 2
    for files, verdict in (
        (grasps[0].backgrounds, "no contact"),
        (black, "not a gel image"),
        ([str(grasps[0].photo)] * 2, "not a gel image"),
    ):
        page = tmp_path / "page.html"
        words = ["query", "--gelsight", *map(str, files), "--index", str(index), "--json", "--html", str(page)]
        assert main(words) == EXIT_CODES[verdict]
        said = json.loads(capsys.readouterr().out)
        assert (said["verdict"], said["results"], said["none_probability"]) == (verdict, [], None)
        assert verdict in page.read_text("utf-8").lower()
        assert "Most likely" not in page.read_text("utf-8")


def test_unscored_objects_keep_their_probability(index, grasps):
    """With two candidates the answer is near the one that judges every photo, as the rest is estimated."""
    with Searcher.open(index) as searcher:
        whole, pruned = (searcher.query(grasps[0].touches, candidates=count, top=2) for count in (99, 2))
        assert pruned.posterior["scored_objects"] < whole.posterior["scored_objects"] == 4
        assert pruned.none_probability == pytest.approx(whole.none_probability, abs=0.05)
        total = pruned.none_probability + sum(match.probability for match in pruned.results)
        assert total + pruned.posterior["unscored_probability"] == pytest.approx(1)


@pytest.mark.parametrize("fingers", SHIPPED)
def test_the_card_of_a_shipped_checkpoint_is_its_own_and_says_how_often_its_check_errs(fingers):
    path = shipped_model(fingers)
    stored, card = read_checkpoint_info(path), path.with_suffix(".md").read_text("utf-8")
    assert card.startswith(f"# {path.name}")
    assert stored.provenance["data_digest"][:16] in card
    assert f"touches rejected as foreign {stored.gel_check.rates['touches_rejected_as_foreign']:.3f}" in card
