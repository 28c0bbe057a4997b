"""The page in a real browser with rigs: grasps of the simulated rig, and live sensors of a rig file."""

import dataclasses

import cv2
import numpy as np
import pytest

from retrieval.data.preprocessing import Preprocessing
from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint
from retrieval.serve.rig import load_live_rig
from retrieval.training.trainer import train_matcher
from robot.sim.rig import SimRig
from tests.browser import address, page
from tests.conftest import TINY
from tests.replay_rig import replay_file
from tests.serving import with_history

pytestmark = pytest.mark.slow
SEED = 20_000
LOADED = "async (one) => { while (!one.naturalWidth) await new Promise((go) => setTimeout(go, 20)); }"


@pytest.fixture(scope="module")
def index(recording, tmp_path_factory):
    """An index of three simulated objects, with a model that subtracts the no-contact frame."""
    folder, rig = tmp_path_factory.mktemp("simulated"), SimRig(SEED)
    for name in rig.object_ids(3):
        (folder / "catalog" / name).mkdir(parents=True)
        rig.prepare(name, 0)
        pixels = np.ascontiguousarray(rig.sim_state.current_scene().image("photo")[..., ::-1])
        assert cv2.imwrite(str(folder / "catalog" / name / "1.jpg"), pixels)
    config = dataclasses.replace(TINY, preprocessing=Preprocessing(touch_px=32, photo_px=48, background="difference"))
    train_matcher(recording, folder / "tiny.safetensors", config)
    build_index(folder / "catalog", load_checkpoint(folder / "tiny.safetensors"), folder / "index")
    return folder / "index"


def live(opened):
    """Open the live sensors and return the loaded picture of one."""
    opened.get_by_role("button", name="Live sensors").click()
    picture = opened.get_by_alt_text("Live picture of sensor b")
    picture.wait_for()
    picture.evaluate(LOADED)
    return picture


def test_simulated_grasps_include_their_no_contact_frames(browser, index, tmp_path):
    with (
        with_history(index, tmp_path, rig=load_live_rig(None, index), serve=address) as url,
        page(browser, url) as opened,
    ):
        assert live(opened).evaluate("one => one.naturalWidth") > 100
        opened.get_by_role("button", name="Grasp something").click()
        opened.locator(".answer").wait_for()
        names = [path.name for path in (index.parent / "catalog").iterdir()]
        name = opened.locator(".grasped-object strong").inner_text()
        assert name in names
        assert opened.get_by_alt_text("Gel image").count() == 2
        opened.get_by_role("button", name="Grasp it again").click()
        opened.locator("legend", has_text="Grasp 2").wait_for()
        opened.get_by_text("Grasped object:").wait_for()
        assert opened.locator(".grasped-object strong").inner_text() == name
        opened.get_by_role("navigation").get_by_role("link", name="History").click()
        opened.locator(".query").first.get_by_role("link").click()
        opened.locator(".answer").wait_for()


def test_sensors_of_a_rig_file_are_live_and_give_no_contact_frames_and_touches(browser, index):
    with replay_file() as file, address(index, load_live_rig(str(file), index)) as url, page(browser, url) as opened:
        live(opened)
        assert opened.get_by_role("button", name="Grasp something").count() == 0  # the page never moves a real rig
        opened.get_by_role("button", name="Take as no-contact frames").click()
        opened.get_by_text("Options").click()
        opened.get_by_role("button", name="Finger b: taken").wait_for()
        opened.get_by_role("button", name="Take this touch").click()
        opened.get_by_alt_text("Gel image, grasp 1, finger b").wait_for()
        opened.get_by_role("button", name="Ask", exact=True).click()
        opened.locator(".answer").wait_for()
