"""Check CONTRIBUTING's table of extensions: each one is added here by the steps that the table lists."""

import dataclasses
import re
import time
from pathlib import Path

import numpy as np
import pytest
import torch

import indexes
import robot
from benchmarks import hard_cases
from indexes.kinds.exact import ExactIndex
from retrieval import frontier
from retrieval.commands import main as command_line
from retrieval.data import views
from retrieval.data.pairs import PairBatch
from retrieval.data.preprocessing import Preprocessing
from retrieval.evaluation.real import PROTOCOLS
from retrieval.evaluation.real.protocol import Protocol, topn_accuracy
from retrieval.frontier.points import ApproximationResult
from retrieval.methods import METHODS
from retrieval.methods.method import MethodSettings
from retrieval.methods.trivial import Chance
from retrieval.metrics import protocols, registry
from retrieval.metrics.registry import Metric
from retrieval.metrics.table import ScoreTable
from retrieval.model import config, towers
from retrieval.model.config import Config, MatcherConfig, TrainingConfig
from retrieval.model.fusion import Matcher
from retrieval.model.losses.loss import Loss
from retrieval.model.losses.match import match_loss
from retrieval.model.towers.small import SmallTower
from retrieval.training.step import WeightedLosses, batch_loss
from robot import real_rig
from robot.devices import TactileSensor
from robot.errors import PlanError
from robot.exporters.exporting import RecordingExport, atomic_folder
from robot.grasping import gates
from robot.grasping.attempt import AttemptRunner, AttemptSettings
from robot.grasping.planner import GraspPlanner
from robot.readings import Frame
from robot.sim.objects import draw, materials, relief, shapes
from robot.sim.rig import SimRig
from tests.documents import CONTRIBUTING, ROOT, table_rows
from tests.hard_case import HardCase
from tests.retrieval.methods import hard_linear as linear

HERE = "tests.project.test_cost_of_change"
TINY = MatcherConfig(tower="small", tower_output="pooled", fingers=1, hidden=4, embedding_dim=4)


def add_a_command(monkeypatch):
    files = {path.stem.strip("_").replace("_", "-") for path in (ROOT / "retrieval/commands").glob("*.py")}
    assert files - {"init", "main", "options"} == set(command_line.COMMANDS)


def add_a_tower(monkeypatch):
    matcher = Matcher(dataclasses.replace(TINY, tower=towers.tower_name(MyTower))).eval()
    assert matcher(torch.rand(1, 1, 3, 32, 32), torch.rand(1, 3, 32, 32)).shape == (1,)


class MyTower(SmallTower):
    pass


def add_a_loss(monkeypatch):
    matcher, labels = Matcher(TINY), np.ones(1, np.float32)
    none = np.zeros(1, np.int64)
    batch = PairBatch([], [], none, none, labels, none, none)
    features = torch.rand(1, matcher.touch_tower.feature_count)
    settings = Config().using(losses={MyLoss: 0.5}).training
    total, logits = batch_loss(matcher.eval(), WeightedLosses(settings.weights, matcher, 9), batch, features, features)
    assert total.item() == pytest.approx(match_loss(logits, torch.from_numpy(labels)).item() + 0.5 * 7)


class MyLoss(Loss):
    def forward(self, batch):
        return torch.tensor(7.0)


def add_a_view_of_a_photo(monkeypatch):
    monkeypatch.setitem(views.VIEWS, "corner", lambda image, box: image[:2, :2])
    photo = np.zeros((8, 8, 3), np.float32)
    photo[:2, :2] = 1
    assert (Preprocessing(photo_px=4, views=("corner",)).photo(photo) == 1).all()


def add_a_method_to_compare(monkeypatch):
    assert isinstance(METHODS.resolve(f"{HERE}:Mine")(MethodSettings(Config())), Mine)


class Mine(Chance):
    pass


def add_a_metric(monkeypatch):
    metric = Metric("worst score", "worst", "main", lambda of: protocols.recall(of.test, 2))
    monkeypatch.setitem(registry.METRICS, "mine", metric)
    owner = np.arange(3)
    table = ScoreTable(np.eye(3, dtype=np.float32), owner, owner, np.zeros((3, 3), bool))
    scored = registry.MethodScoreTables(table, table, {}, None, 0)
    assert registry.compute(scored, ["mine"])["mine"].values.shape == (3, 1)


def add_a_protocol_of_real_data(monkeypatch):
    assert PROTOCOLS.resolve(f"{HERE}:MY_PROTOCOL").main == "topn_k3"


MY_PROTOCOL = Protocol("vt60", "Mine", "Nothing is split.", lambda facts, seed: [], topn_accuracy(3))


def add_a_kind_of_index(monkeypatch):
    vectors = np.eye(2, dtype=np.float32)
    assert indexes.load_kind(indexes.KINDS.name_of(MyIndex)).build(vectors).search(vectors[1:], 1)[1].tolist() == [[1]]


class MyIndex(ExactIndex):
    pass


def add_a_device(monkeypatch):
    sensor = real_rig.load_driver("sensors", {"driver": f"{HERE}:Grey"}, "[sensors.a]", finger="a")
    with sensor:
        assert sensor.read().pixels.shape == (4, 4, 3)


class Grey(TactileSensor):
    def __init__(self, finger, *, clock=time.monotonic):
        super().__init__("grey", finger, clock=clock)

    def _connect(self): ...

    def _close(self): ...

    def _read(self):
        return Frame(np.full((4, 4, 3), 128, np.uint8), self.clock())


def add_a_setting_of_a_device(monkeypatch):
    with pytest.raises(robot.RobotError, match="timeout_s"):
        real_rig.load_driver("gripper", {"driver": "wsg50", "port": "/dev/null", "timeout_s": -1.0}, "[gripper]")


def add_a_grasp_planner(monkeypatch):
    rig = robot.load_rig("sim", seed=3, planner={"name": f"{HERE}:Nowhere", "place": "the moon"})
    with rig:
        attempt = AttemptRunner(rig, 3, AttemptSettings()).run(rig.object_ids(1)[0], 0)
    assert attempt.reason == "the moon is out of reach"


class Nowhere(GraspPlanner):
    needs_depth = False

    def __init__(self, *, place: str):
        self.place = place

    def plan(self, rig, image, settings, rng):
        raise PlanError(f"{self.place} is out of reach")


def add_a_rig(monkeypatch):
    assert isinstance(robot.load_rig(f"{HERE}:MyRig", seed=1), MyRig)


class MyRig(SimRig):
    pass


def add_a_shape_relief_or_material(monkeypatch):
    tables = {shapes.families: "SHAPES", relief: "RELIEFS", materials: "MATERIALS"}
    for module, name in tables.items():
        table = getattr(module, name)
        assert all(f'"{entry}"' in Path(module.__file__).read_text() or hasattr(module, entry) for entry in table)
    for name in relief.RELIEFS:
        assert draw.draw_object(0, 0, relief=name).relief.name == name


def add_a_gate(monkeypatch):
    assert gates.apply_gate(lambda touches: 0.75, {}) == (True, 0.75)


def add_an_importer(monkeypatch, tmp_path):
    (tmp_path / "source").mkdir()
    assert (
        command_line.main(["import", f"{HERE}:imported", str(tmp_path / "source"), "--out", str(tmp_path / "out")]) == 0
    )


def imported(source, out, progress=None):
    picture = np.zeros((2, 2, 3), np.uint8)
    with robot.RecordingWriter(out, {"source": "mine", "sensor": "mine", "background": "none"}) as writer:
        writer.append("1", "a", {"photo": picture, "touch_a": picture})
    return robot.read_recording(out)


def add_a_format_to_export_to(monkeypatch, tmp_path):
    imported(tmp_path, tmp_path / "r")
    to = ["--to", f"{HERE}:exported", "--out", str(tmp_path / "o")]
    assert command_line.main(["export-recording", str(tmp_path / "r"), *to]) == 0
    assert (tmp_path / "o" / "mine").read_text() == "1"


def exported(recording, out, *, parts=None, progress=None):
    with atomic_folder(out) as folder:
        (folder / "mine").write_text(recording.grasps[0].grasp_id)
    return RecordingExport(out, 1)


def add_an_approximation_to_measure(monkeypatch):
    monkeypatch.setitem(frontier.APPROXIMATIONS, "mine", f"{HERE}:approximation")
    assert frontier.load_approximation("mine")(None).title == "mine"


def approximation(sample):
    return ApproximationResult("mine", "", ())


def add_a_hard_case(monkeypatch):
    case = HardCase("mine", "", "", "", "", True, False)
    monkeypatch.setattr(linear, "hard_cases", lambda: [case])
    monkeypatch.setattr(hard_cases, "KERNELS", {"retrieval": (linear.__name__,)})
    assert hard_cases.hard_cases("retrieval") == [case]


def add_a_preset(monkeypatch):
    files = {path.stem for path in (ROOT / "retrieval/configs").glob("*.toml")}
    assert set(config.preset_names()) == files
    for name in files:
        assert isinstance(config.load_config(name).training, TrainingConfig)


def add_a_page(monkeypatch):
    nav = (ROOT / "zensical.toml").read_text()
    assert all(f'"{page.name}"' in nav for page in (ROOT / "docs").glob("*.md"))


def rows():
    """Return the possible extensions, and the cells with their steps."""
    return {cells[0]: cells[1:] for cells in table_rows(CONTRIBUTING) if re.match("an? ", cells[0])}


ADDED = {name.removeprefix("add_"): value for name, value in list(globals().items()) if name.startswith("add_")}


def words(row):
    return row.replace(",", "").replace(" ", "_")


def test_every_row_of_the_table_is_tested_here_and_no_other():
    assert {words(row) for row in rows()} == set(ADDED)


@pytest.mark.parametrize("row", rows())
def test_the_steps_in_the_table_are_sufficient(row, monkeypatch, tmp_path):
    add = ADDED[words(row)]
    add(monkeypatch, *([tmp_path] if "tmp_path" in add.__code__.co_varnames else []))


@pytest.mark.parametrize("row", rows())
def test_a_row_names_few_files(row):
    """A file to write and a registration; three files if one row describes three extensions."""
    named = re.findall(r"`((?:retrieval|robot|indexes|docs|tests|benchmarks)/[\w/.]*)`", " ".join(rows()[row]))
    assert len(named) <= 3
    assert all((ROOT / name).exists() for name in named)
