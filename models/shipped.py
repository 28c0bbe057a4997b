"""The checkpoints of the package: their training, and their accuracy on unseen objects.

    python -m models.shipped make FOLDER --meshes MESHES
        collect grasps of procedural objects and of meshes on simulated rigs, and photos of them by other cameras, on
        other grounds and with faults; train the shipped towers further, and a head for two fingers and one for one
        finger; calibrate both, and store them in FOLDER
    python -m models.shipped calibrate FOLDER --meshes MESHES
        calibrate the shipped checkpoints again; keep their weights
    python -m models.shipped score FOLDER
        collect other objects into FOLDER/recording, and evaluate the shipped checkpoint on them: FOLDER/report; with
        --fingers 1 that for one finger, in FOLDER/report-one-finger

An interrupted job continues. Accuracy on simulated touches does not predict accuracy on real sensors.
"""

import argparse
import dataclasses
import hashlib
import itertools
import json
import sys
import zlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from models.labels import LabelTrainer
from models.meshes import vary_meshes
from models.pictures import collect_pictures, load_object_labels, load_pictures
from retrieval.commands.main import main as run_command
from retrieval.console.memory import keep_freed_memory
from retrieval.data.dataset import LICENCES, Grasp, Split, data_digest, load_grasps
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import RgbImage
from retrieval.data.views import FIELD_MM
from retrieval.methods.late_fusion import frozen_matcher, trained_checkpoint
from retrieval.methods.method import MethodSettings
from retrieval.model.card import SHIPPED_DATA
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint, write_tensors
from retrieval.model.config import Config, load_config
from retrieval.model.encode import default_device, one_thread
from retrieval.model.shipped import SHIPPED, shipped_model
from retrieval.training import distil
from retrieval.training.calibration import calibrate_checkpoint, fit_verification, refused_touches, score_grasps
from retrieval.training.features import (
    Features,
    FrozenFeatures,
    TrainedFeatures,
    encode_recording,
    features_by_image,
    recorded_features,
)

RIGS = Path(__file__).parent
RIG = RIGS / "shipped_rig.toml"


class Part(NamedTuple):
    """One recording: optics of its gels, procedural objects or meshes, and numbers of objects, grasps and gel pairs."""

    optics: str
    has_meshes: bool
    seed: int
    objects: int
    grasps: int = 2
    gels: int = 4  # with more, a rig computes the properties of a gel again for nearly every object


PARTS = (
    *(Part("led", False, 113_000 + number, 200) for number in range(8)),
    *(Part("varied", False, 123_000 + number, 200) for number in range(4)),
    *(Part("gelsight", False, 124_000 + number, 200) for number in range(2)),
    Part("gelsight_mini", False, 125_000, 200),
    *(Part("led", True, 126_000 + number, 200) for number in range(4)),
    Part("varied", True, 127_000, 200),
)
RECORDINGS, CALIBRATION = "recordings", "calibration"
"""Folders of the recordings."""
CALIBRATED = {
    "validation": (Part("led", False, 150_000, 80, 6, gels=25), Part("led", True, 151_000, 50, 6, gels=25)),
    "verification": (Part("led", False, 130_000, 100, 5, gels=25), Part("led", True, 131_000, 50, 5, gels=25)),
    "gels": (
        Part("led", False, 140_000, 300, 1, gels=200),
        Part("gelsight", False, 142_000, 50, 1, gels=25),
        Part("gelsight_mini", False, 143_000, 50, 1, gels=25),
    ),
    "varied_gels": (Part("varied", False, 141_000, 200, 1, gels=200),),
}
"""Recordings that choose the step and calibrate the model; that fit the bounds of verifications; that fit, besides, the
check of gel images, and choose its thresholds by gels that it was not fitted to; and that only fit this check."""
CALIBRATION_MESHES = 5
"""One of this many meshes is for calibration only."""
SEED_SCORED = 30_000
"""Seed of the scored objects. The demo has its own (retrieval.commands.demo.SEED), the benchmark has 0."""
TOWERS, HEADS = RIGS / "shipped_towers.toml", RIGS / "shipped_heads.toml"
"""Configurations of the training of the towers and of the heads. The last step of the towers is used: the head that is
trained together with them does not tell which step has the best towers."""
HEAD_STEPS = 400
FOREIGN = 8000
"""Number of non-gel pictures for training its check of touches: more than in an ordinary training."""
FOREIGN_MARGIN = -1.0
"""Margin of its threshold, lower than for gels of one kind: otherwise too many photos would be taken for gel images."""
DISTIL_STEPS = 4000
"""Training steps of its candidate encoder, more than the preset's: it is trained once and used by everyone."""
FITTED = 10
"""Scored objects for calibration, and as many training objects for other fits; the rest are the test set."""


def main(argv: list[str] | None = None) -> int:
    """Run one of the jobs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    jobs = parser.add_subparsers(dest="job", required=True)
    make = jobs.add_parser("make", help="collect and train the checkpoints that come with the package")
    calibrate_job = jobs.add_parser("calibrate", help="calibrate the shipped checkpoints again; keep their weights")
    score = jobs.add_parser("score", help="evaluate a checkpoint on other objects")
    score.add_argument("--objects", type=int, default=120)
    score.add_argument("--grasps", type=int, default=8)
    score.add_argument("--model", type=Path, help="another checkpoint than the shipped one")
    score.add_argument("--fingers", type=int, choices=tuple(SHIPPED), default=2, help="gel images of a touch")
    for job in (make, calibrate_job):
        job.add_argument("--meshes", type=Path, required=True, help="folder of closed meshes (STL)")
    for job in (make, calibrate_job, score):
        job.add_argument("folder", type=Path)
        job.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args(argv)
    keep_freed_memory()
    return {"make": make_shipped, "calibrate": calibrate_shipped, "score": score_shipped}[arguments.job](arguments)


def make_shipped(arguments: argparse.Namespace) -> int:
    """Collect, train the towers and both heads, and calibrate; continue an interrupted run."""
    folder = arguments.folder
    if code := collect_training(arguments) or collect_calibration(arguments):
        return code
    last = train_towers(folder)
    for fingers, name in SHIPPED.items():
        trained = for_fingers(last, fingers)
        made = distilled(train_head(trained), *trained.features)
        if made.queries is not None:  # the file stays below 12 MB
            made = dataclasses.replace(made, queries=made.queries[::2])
        store(calibrated(made, folder, fingers), folder / name)
    return 0


class StatedFields(Preprocessing):
    """Preprocessing in which the field of every second varied photo is stated."""

    def __init__(self, settings: Preprocessing, recordings: Iterable[Path]) -> None:
        """Read the fields of the varied photos of some recordings."""
        super().__init__(**settings.to_dict())
        pictures = [picture for recording in recordings for picture in load_pictures(varied_photos(recording))]
        self.fields = {each.file: each.field_mm for each in pictures if zlib.crc32(each.file.name.encode()) % 2}

    def load_photo(self, path: str | Path, field_mm: float = FIELD_MM) -> RgbImage:
        """Read a photo with its stated field."""
        return super().load_photo(path, self.fields.get(Path(path)) or field_mm)

    def digest(self) -> str:
        """Return the SHA-256 of settings and fields."""
        fields = {file.name: field for file, field in self.fields.items()}
        return hashlib.sha256(json.dumps([super().digest(), fields], sort_keys=True).encode()).hexdigest()


class Trained(NamedTuple):
    """Trained towers, the configuration of heads on them, and training and validation grasps with their features."""

    folder: Path
    towers: Checkpoint
    config: Config
    grasps: tuple[list[Grasp], list[Grasp]]
    features: tuple[Features, Features]


def train_towers(folder: Path, **settings: Any) -> Trained:
    """Train both towers further, with the head of two fingers; `settings` change those of TOWERS."""
    parts = [folder / RECORDINGS / str(part.seed) for part in PARTS]
    train = [grasp for part in parts for grasp in grasps_of_each_photo(part)]
    validation = calibration_grasps(folder, "validation")
    config = load_config(TOWERS)
    training = dataclasses.replace(config.training, start=str(shipped_model(2)), **settings)
    trainer = LabelTrainer(
        dataclasses.replace(config, training=training),
        split_of(train, []),
        train,
        folder / "towers.safetensors",
        {"source": "simulated rigs", "data_digest": data_digest(train)},
        labels={name: labels for part in parts for name, labels in load_object_labels(part).items()},
    )
    stated = StatedFields(config.preprocessing, parts)
    trainer.features = TrainedFeatures(dataclasses.replace(config, preprocessing=stated), trainer.device)
    towers = trainer.run_or_reuse(quiet=False)
    config = head_config(folder, towers)
    matcher, cache = frozen_matcher(config), folder / "features"
    features = encode_recording(train, matcher, dataclasses.replace(config, preprocessing=stated), cache)
    validated = encode_recording(validation, matcher, config, cache)
    return Trained(folder, towers, config, (train, validation), (features, validated))


def calibration_grasps(folder: Path, name: str) -> list[Grasp]:
    """Return the grasps of one of CALIBRATED."""
    recordings = (folder / CALIBRATION / name / str(part.seed) for part in CALIBRATED[name])
    return [grasp for recording in recordings for grasp in load_grasps(recording)]


def grasps_of_each_photo(recording: Path) -> list[Grasp]:
    """Return the grasps of a recording with their own photos, and again with each varied photo of their objects."""
    grasps = load_grasps(recording)
    of_object: dict[str, list[Grasp]] = {}
    for grasp in grasps:
        of_object.setdefault(grasp.object_id, []).append(grasp)
    return grasps + [
        dataclasses.replace(grasp, grasp_id=f"{grasp.grasp_id}-{file.stem}", photo_file=file)
        for name, files in photos_by_object(recording).items()
        for file, grasp in zip(files, itertools.cycle(of_object.get(name, [])))
    ]


def photos_by_object(recording: Path) -> dict[str, list[Path]]:
    """Return the varied photos of each object of a recording."""
    files: dict[str, list[Path]] = {}
    for picture in load_pictures(varied_photos(recording)):
        files.setdefault(picture.object_id, []).append(picture.file)
    return files


def varied_photos(recording: Path) -> Path:
    """Return the folder of the varied photos of a recording's objects."""
    return recording.with_name(f"{recording.name}-photos")


def head_config(folder: Path, towers: Checkpoint) -> Config:
    """Return the configuration of a head on the trained towers, and write the weights that it names."""
    config = load_config(HEADS)
    training = dataclasses.replace(config.training.with_iterations(HEAD_STEPS), **tower_weights(folder, towers))
    return dataclasses.replace(config, training=training)


def tower_weights(folder: Path, made: Checkpoint) -> dict[str, str]:
    """Write the towers of a checkpoint into `folder`; return the settings that name them as initial weights."""
    files = {}
    for side, tower in (("touch", made.matcher.touch_tower), ("photo", made.matcher.photo_tower)):
        file = folder / f"trained-{side}-tower.safetensors"
        write_tensors(file, tower.state_dict(), {"from": made.digest})
        files[f"init_{side}"] = str(file)
    return files


def train_head(trained: Trained) -> Checkpoint:
    """Train a head further on the features of the towers, for its number of fingers.

    That of two fingers begins as it was trained with the towers, that of one finger as the shipped one.
    """
    fingers, start = trained.config.matcher.fingers, trained.towers
    if fingers == 1:
        start = load_checkpoint(shipped_model(1))
        for name in ("touch_tower", "photo_tower"):
            getattr(start.matcher, name).load_state_dict(getattr(trained.towers.matcher, name).state_dict())
    settings = MethodSettings(trained.config, folder=trained.folder / f"{fingers}-fingers", start=start, quiet=False)
    made = trained_checkpoint(settings, *trained.features)
    train, validation = trained.grasps
    about = {"source": "simulated rigs", "data_digest": data_digest([*train, *validation])}
    return dataclasses.replace(made, provenance=made.provenance | about, split=split_of(train, validation))


def for_fingers(trained: Trained, fingers: int) -> Trained:
    """Return the trained towers for heads of one finger, whose grasps are the touches of each finger, or of two."""
    matcher = dataclasses.replace(trained.config.matcher, fingers=fingers)
    trained = trained._replace(config=dataclasses.replace(trained.config, matcher=matcher))
    if fingers == 2:
        return trained
    train, validation = ([one for grasp in part for one in each_finger(grasp)] for part in trained.grasps)
    features, validated = map(each_finger_features, trained.features)
    return trained._replace(grasps=(train, validation), features=(features, validated))


def split_of(train: list[Grasp], validation: list[Grasp]) -> Split:
    """Return the split of training and validation grasps."""
    return Split(0, *(tuple(sorted({grasp.object_id for grasp in part})) for part in (train, validation, [])))


def each_finger(grasp: Grasp) -> list[Grasp]:
    """Return the touch of each finger as a separate grasp."""
    return [
        dataclasses.replace(
            grasp,
            grasp_id=f"{grasp.grasp_id}-{finger}",
            touches=grasp.touches[row : row + 1],
            backgrounds=grasp.backgrounds[row : row + 1],
        )
        for row, finger in enumerate("ab")
    ]


def each_finger_features(features: Features) -> Features:
    """Return the features of `each_finger` of all grasps."""
    return Features(
        tuple(f"{name}-{finger}" for name in features.grasp_ids for finger in "ab"),
        tuple(name for name in features.object_ids for _ in "ab"),
        features.touch.reshape(-1, 1, features.touch.shape[2]),
        features.photo.repeat(2, axis=0),
    )


def collect_training(arguments: argparse.Namespace) -> int:
    """Collect the training recordings, and varied photos of their objects."""
    folder = arguments.folder
    if code := collect_parts(arguments, PARTS, folder / RECORDINGS, mesh_files(arguments)[0]):
        return code
    for part in PARTS:
        rig, photos = rig_file(folder, part), varied_photos(folder / RECORDINGS / str(part.seed))
        collect_pictures("varied", photos, objects=part.objects, seed=part.seed, rig=str(rig), jobs=arguments.jobs)
    return 0


def collect_calibration(arguments: argparse.Namespace) -> int:
    """Collect the recordings of CALIBRATED."""
    meshes = mesh_files(arguments)[1]
    for name, parts in CALIBRATED.items():
        if code := collect_parts(arguments, parts, arguments.folder / CALIBRATION / name, meshes):
            return code
    return 0


def mesh_files(arguments: argparse.Namespace) -> tuple[Iterator[Path], Iterator[Path]]:
    """Return the meshes for training, and others for calibration, again and again."""
    files = sorted(arguments.meshes.glob("*.stl"))
    calibrated = files[::CALIBRATION_MESHES]
    return itertools.cycle(sorted(set(files) - set(calibrated))), itertools.cycle(calibrated)


def collect_parts(arguments: argparse.Namespace, parts: Sequence[Part], out: Path, meshes: Iterator[Path]) -> int:
    """Collect grasps of all parts."""
    folder, jobs = arguments.folder, arguments.jobs
    out.mkdir(parents=True, exist_ok=True)
    rigs = [write_rig(folder, part, meshes) for part in parts]
    for part, rig in zip(parts, rigs, strict=True):
        if code := collect(out / str(part.seed), rig, part.objects, part.grasps, part.seed, jobs):
            return code
    return 0


def write_rig(folder: Path, part: Part, meshes: Iterator[Path]) -> Path:
    """Write the rig of a recording, with the next of the meshes in random sizes, and return its file."""
    rig = rig_file(folder, part)
    settings: dict[str, Any] = {"rig": "sim", "gels": part.gels, "optics": part.optics}
    if part.has_meshes:
        settings["meshes"] = str(vary_meshes(meshes, part.objects, folder / "meshes" / str(part.seed), part.seed))
    rig.write_text("".join(f"{key} = {json.dumps(value)}\n" for key, value in settings.items()))
    return rig


def rig_file(folder: Path, part: Part) -> Path:
    """Return the file of the rig of a recording."""
    return folder / f"{part.seed}.toml"


def calibrate_shipped(arguments: argparse.Namespace) -> int:
    """Calibrate both shipped checkpoints again: posterior, gel check, references, openings, bounds of verifications."""
    if code := collect_calibration(arguments):
        return code
    for fingers, name in SHIPPED.items():
        shipped = load_checkpoint(shipped_model(fingers))
        store(calibrated(shipped, arguments.folder, fingers), arguments.folder / name)
    return 0


def calibrated(made: Checkpoint, folder: Path, fingers: int) -> Checkpoint:
    """Return a checkpoint with its gel check, posterior, calibration of reference touches and bounds."""
    parts = [calibration_grasps(folder, name) for name in CALIBRATED]
    if fingers == 1:
        parts = [[each_finger(grasp)[0] for grasp in part] for part in parts]
    validation, verification, gels, varied = parts
    every, device = [*validation, *verification, *gels, *varied], default_device()
    features = encode_recording(every, made.matcher, made.config, folder / "features")
    source = FrozenFeatures(made.config, features_by_image(every, features, device))
    names = sorted({grasp.object_id for grasp in gels})
    fitting, others = ([grasp for grasp in gels if grasp.object_id in names[side::2]] for side in (0, 1))
    held_out = [*validation, *others]
    made = calibrate_checkpoint(
        made,
        source,
        [*fitting, *varied],
        held_out,
        foreign=FOREIGN,
        foreign_margin=FOREIGN_MARGIN,
        max_grasps=len(every),
    )
    touches, photos = recorded_features(made.matcher, source, verification)
    trials = score_grasps(made.matcher, verification, touches, photos)
    assert trials is not None
    assert made.posterior is not None
    refused = [refused_touches(made, touches)]
    return dataclasses.replace(made, verification=fit_verification([trials], made.posterior, refused=refused))


def distilled(made: Checkpoint, train: Features, validation: Features) -> Checkpoint:
    """Return a checkpoint with the preset's candidate encoder."""
    training = dataclasses.replace(made.config.training, distil_steps=DISTIL_STEPS)
    config = dataclasses.replace(made.config.with_candidate_encoder_of(load_config(HEADS)), training=training)
    with one_thread():  # like training on frozen features
        partials = (distil.feature_partials(made.matcher, part) for part in (train, validation))
        return distil.with_candidate_encoder(made, config, *partials)


def store(made: Checkpoint, out: Path) -> None:
    """Write a checkpoint as float16, with its licence, without the paths of its first weights on this machine."""
    training = dataclasses.replace(made.config.training, init="imagenet", init_photo="", init_touch="")
    made = dataclasses.replace(
        made,
        config=dataclasses.replace(made.config, training=training),
        provenance=made.provenance | {LICENCES: [dataclasses.asdict(SHIPPED_DATA)]},
    )
    made.matcher.half()  # halves the file; loading converts the weights to float32
    store_checkpoint(made, out)


def score_shipped(arguments: argparse.Namespace) -> int:
    """Write the whole report on objects of another seed, touched by other gels."""
    recording = arguments.folder / "recording"
    if code := collect(recording, RIG, arguments.objects, arguments.grasps, SEED_SCORED, arguments.jobs):
        return code
    split = recording.with_name("split.json")
    split.write_text(json.dumps(draw_split(load_grasps(recording), FITTED, FITTED).to_dict(), indent=1) + "\n")
    model = arguments.model or shipped_model(arguments.fingers)
    out = arguments.folder / "report"
    if arguments.fingers == 1:
        recording, out = first_finger(recording), arguments.folder / "report-one-finger"
    return retrieve("evaluate", recording, "--model", model, "--methods", "chance", "--split", split, "--out", out)


def first_finger(recording: Path) -> Path:
    """Write a recording of the same grasps with only one finger, next to `recording`; images are linked."""
    out = recording.with_name(recording.name + "-one-finger")
    out.mkdir(exist_ok=True)
    if not (out / "images").exists():
        (out / "images").symlink_to((recording / "images").resolve(), target_is_directory=True)
    (out / "recording.json").write_bytes((recording / "recording.json").read_bytes())
    lines = [json.loads(line) for line in (recording / "metadata.jsonl").read_text().splitlines()]
    one_finger = [{name: value for name, value in line.items() if not name.startswith("touch_b_")} for line in lines]
    (out / "metadata.jsonl").write_text("".join(json.dumps(line) + "\n" for line in one_finger))
    return out


def draw_split(grasps: list[Grasp], train: int, validation: int) -> Split:
    """Split objects: `validation` for validation, `train` for training, the rest for test."""
    names = sorted({grasp.object_id for grasp in grasps})
    names = [str(name) for name in np.random.default_rng(0).permutation(names)]
    parts = names[validation : validation + train], names[:validation], names[validation + train :]
    return Split(0, *(tuple(sorted(part)) for part in parts))


def collect(out: Path, rig: Path, objects: int, grasps: int, seed: int, jobs: int) -> int:
    """Run `retrieve collect` on a simulated rig."""
    size = ("--objects", objects, "--grasps", grasps, "--seed", seed, "--jobs", jobs)
    return retrieve("collect", "--rig", rig, *size, "--out", out)


def retrieve(*arguments: object) -> int:
    """Print a command as a user would type it, and run it."""
    words = [str(argument) for argument in arguments]
    print("$ retrieve " + " ".join(words), file=sys.stderr, flush=True)
    return run_command(words)


if __name__ == "__main__":
    sys.exit(main())
