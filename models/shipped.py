"""The checkpoints of the package: their training, and their accuracy on unseen objects.

    python -m models.shipped make FOLDER --meshes MESHES
        collect grasps of procedural objects and of meshes on simulated rigs, the same grasps by other sensors, and
        photos of the objects by other cameras, on other grounds and with faults; train the shipped towers further, and
        their late interaction; calibrate the checkpoints for two fingers and for one, and store both in FOLDER
    python -m models.shipped calibrate FOLDER --meshes MESHES
        calibrate the shipped checkpoints again; keep their weights
    python -m models.shipped score FOLDER
        collect other objects into FOLDER/recording, and evaluate the shipped checkpoint for two fingers on them:
        FOLDER/report

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
import torch
from torch import Tensor

from models.invariance import CELLS, InvariantTrainer, References
from models.meshes import vary_meshes
from models.pictures import collect_pictures, load_pictures
from retrieval.commands.main import main as run_command
from retrieval.console.memory import keep_freed_memory
from retrieval.console.progress import show_progress
from retrieval.data.camera import USUAL_CAMERA, PhotoCamera
from retrieval.data.dataset import LICENCES, Grasp, Split, data_digest, load_grasps
from retrieval.data.preprocessing import Preprocessing
from retrieval.data.resize import RgbImage
from retrieval.model.card import SHIPPED_DATA
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint
from retrieval.model.config import load_config
from retrieval.model.encode import default_device
from retrieval.model.shipped import SHIPPED, shipped_model
from retrieval.training import distil
from retrieval.training.batches import FrozenFeatures, TrainedFeatures, recorded_features
from retrieval.training.calibration.checkpoint import calibrate_checkpoint, refused_touches
from retrieval.training.calibration.gel_check import ForeignPictures
from retrieval.training.calibration.scores import score_grasps
from retrieval.training.calibration.verification import fit_verification
from retrieval.training.features import encode_recording, features_by_image

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

    @property
    def name(self) -> str:
        """Name of its folder and of its rig's file."""
        return f"{self.seed}-{self.optics}"


PARTS = (
    *(Part("led", False, 113_000 + number, 200) for number in range(8)),
    *(Part("led", True, 126_000 + number, 200) for number in range(2)),
)
CELL_PARTS = (
    *PARTS,
    *(Part("led", False, 113_000 + number, 200) for number in range(8, 25)),
    *(Part("led", True, 126_000 + number, 200) for number in range(2, 9)),
)
"""Recordings for the training of the towers, and of the late interaction."""
OTHER_SENSORS = (
    *(Part("varied", False, 113_000 + number, 200, gels=40) for number in (0, 1, 4)),
    *(Part("gelsight", False, 113_005 + number, 200) for number in range(2)),
    Part("gelsight_mini", False, 113_007, 200),
)
"""Recordings of the same grasps of the same objects: the seeds are those of PARTS."""
RECORDINGS, CALIBRATION = "recordings", "calibration"
"""Folders of the recordings."""
CALIBRATED = {
    "validation": (Part("led", False, 150_000, 80, 6, gels=25), Part("led", True, 151_000, 50, 6, gels=25)),
    "verification": (
        Part("led", False, 130_000, 100, 5, gels=25),
        Part("led", True, 131_000, 50, 5, gels=25),
        Part("led", True, 132_000, 100, 5, gels=25),
    ),
    "gels": (
        Part("led", False, 140_000, 300, 1, gels=200),
        Part("gelsight", False, 142_000, 50, 1, gels=25),
        Part("gelsight_mini", False, 143_000, 50, 1, gels=25),
    ),
    "varied_gels": (Part("varied", False, 141_000, 200, 1, gels=200),),
}
"""Recordings that calibrate the model; that fit the bounds of verifications; that fit, besides, the
check of gel images, and choose its thresholds by gels that it was not fitted to; and that only fit this check, with
varied photos of their objects as pictures that are no gels."""
CALIBRATION_MESHES = 5
"""One of this many meshes is for calibration only."""
SEED_SCORED = 30_000
"""Seed of the scored objects. The demo has its own (retrieval.commands.demo.SEED), the benchmark has 0."""
TOWERS = RIGS / "shipped_towers.toml"
"""Configuration of the training of the towers."""
TOWER_PARTS = ("touch_tower", "photo_tower")
"""Names of the towers in a matcher."""
CELL_TRAINING = {"iterations": 900, "learning_rate": 5e-4}
"""Settings of the training of the late interaction that differ from those of the shipped checkpoint."""
TRAINED_SHARE = 0.7
"""Share of the trained weights in the towers and in the late interaction; the rest are those of the start model."""
FOREIGN = ForeignPictures(8000, margin=-3.0)
"""Foreign pictures of its check of touches: more than in an ordinary training. The margin is lower than for gels of one
kind: otherwise too many photos would be taken for gel images."""
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
    for job in (make, calibrate_job):
        job.add_argument("--meshes", type=Path, required=True, help="folder of closed meshes (STL)")
    for job in (make, calibrate_job, score):
        job.add_argument("folder", type=Path)
        job.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args(argv)
    show_progress()
    keep_freed_memory()
    return {"make": make_shipped, "calibrate": calibrate_shipped, "score": score_shipped}[arguments.job](arguments)


def make_shipped(arguments: argparse.Namespace) -> int:
    """Collect, train the towers, and calibrate both checkpoints with them; continue an interrupted run."""
    folder = arguments.folder
    if code := collect_training(arguments) or collect_calibration(arguments):
        return code
    towers = train_towers(folder)
    for fingers, name in SHIPPED.items():
        made = with_parts(load_checkpoint(shipped_model(fingers)), towers, TOWER_PARTS)
        store(calibrated(train_cells(made, folder), folder, fingers), folder / name)
    return 0


class StatedFields(Preprocessing):
    """Preprocessing in which the field of every second varied photo is stated."""

    def __init__(self, settings: Preprocessing, recordings: Iterable[Path]) -> None:
        """Read the fields of the varied photos of some recordings."""
        super().__init__(**settings.to_dict())
        pictures = [picture for recording in recordings for picture in load_pictures(varied_photos(recording))]
        self.fields = {each.file: each.field_mm for each in pictures if zlib.crc32(each.file.name.encode()) % 2}

    def load_photo(self, path: str | Path, camera: PhotoCamera = USUAL_CAMERA) -> RgbImage:
        """Read a photo with its stated field."""
        return super().load_photo(path, camera._replace(field_mm=self.fields.get(Path(path)) or camera.field_mm))

    def digest(self) -> str:
        """Return the SHA-256 of settings and fields."""
        fields = {file.name: field for file, field in self.fields.items()}
        return hashlib.sha256(json.dumps([super().digest(), fields], sort_keys=True).encode()).hexdigest()


class TrainingImages(NamedTuple):
    """Grasps for training, and the rig's images that are the references of their images (`models.invariance`).

    Attributes:
        grasps: Grasps by the rig's sensors and by others, each with a photo of the rig or a varied one.
        rig_grasps: The grasp by the rig's sensors, for each grasp id.
        rig_photos: A photo of the object by the rig, for each photo file.
    """

    grasps: list[Grasp]
    rig_grasps: dict[str, Grasp]
    rig_photos: dict[Path, Path]


def train_towers(folder: Path, **settings: Any) -> Checkpoint:
    """Train both towers further, below the shipped head of two fingers; `settings` change those of TOWERS.

    The head stays: training it further made the rig's accuracy worse.
    """
    images, parts = training_images(folder, PARTS), [recording_of(folder, part) for part in PARTS]
    start, config = load_checkpoint(shipped_model(2)), load_config(TOWERS)
    training = dataclasses.replace(config.training, start=str(start.path), **settings)
    stated = StatedFields(config.preprocessing, parts)
    trainer = InvariantTrainer(
        dataclasses.replace(config, training=training),
        split_of(images.grasps, []),
        images.grasps,
        folder / "towers.safetensors",
        {"source": "simulated rigs", "data_digest": data_digest(images.grasps)},
        TrainedFeatures(dataclasses.replace(config, preprocessing=stated), default_device()),
        references=references(start, images, folder / "features"),
    )
    return averaged(start, trainer.run_or_reuse())


def train_cells(made: Checkpoint, folder: Path, **settings: Any) -> Checkpoint:
    """Train the late interaction of a checkpoint further; `settings` change those of CELL_TRAINING."""
    start, grasps = load_checkpoint(shipped_model(made.config.matcher.fingers)), list[Grasp]()
    known, expected = dict[str | Path, Tensor](), dict[str | Path, Tensor]()
    for part in CELL_PARTS:
        images = training_images(folder, [part], made.config.matcher.fingers)
        stated = StatedFields(made.config.preprocessing, [recording_of(folder, part)])
        config = dataclasses.replace(made.config, preprocessing=stated)
        features = encode_recording(images.grasps, made.matcher, config, folder / "features")
        known |= features_by_image(images.grasps, features, default_device())
        expected |= references(dataclasses.replace(start, config=config), images, folder / "features")
        grasps += images.grasps
    training = made.config.training.with_given_weights(**CELL_TRAINING | settings)
    config = dataclasses.replace(made.config, training=training)
    trainer = InvariantTrainer(
        config,
        split_of(grasps, []),
        grasps,
        folder / f"cells-{made.config.matcher.fingers}.safetensors",
        {"source": "simulated rigs", "data_digest": data_digest(grasps)},
        FrozenFeatures(known),
        parts=CELLS,
        references=expected,
        weights=made.matcher.state_dict(),
    )
    return with_parts(made, averaged(made, trainer.run_or_reuse()), CELLS)


def averaged(start: Checkpoint, trained: Checkpoint) -> Checkpoint:
    """Return the trained model with weights averaged with those of the start model (Wortsman et al., CVPR 2022).

    It is as good as the trained model with other cameras and sensors, and nearly as good as the start model on the rig.
    """
    before = start.matcher.state_dict()
    weights = {
        name: before[name].lerp(after, TRAINED_SHARE) if after.is_floating_point() else after
        for name, after in trained.matcher.state_dict().items()
    }
    trained.matcher.load_state_dict(weights)
    return trained


def training_images(folder: Path, parts: Iterable[Part], fingers: int = 2) -> TrainingImages:
    """Return the images of recordings for training: each object's touches and photos in turn."""
    images = TrainingImages([], {}, {})
    for part in parts:
        recording = recording_of(folder, part)
        rig, varied = of_fingers(load_grasps(recording), fingers), photos_by_object(recording)
        known, of_rig = {grasp.grasp_id: grasp for grasp in rig}, grasps_by_object(rig)
        sensors = [recording_of(folder, other) for other in OTHER_SENSORS if other.seed == part.seed]
        others = [grasp for sensor in sensors for grasp in load_grasps(sensor) if grasp.grasp_id in known]
        for name, touches in grasps_by_object([*rig, *of_fingers(others, fingers)]).items():
            own = [grasp.photo for grasp in of_rig[name]]
            photos = own + varied.get(name, [])
            images.rig_photos.update(dict.fromkeys(photos, own[0]) | dict(zip(own, own, strict=True)))
            for turn in range(max(len(touches), len(photos))):
                grasp, file = touches[turn % len(touches)], photos[turn % len(photos)]
                named = dataclasses.replace(grasp, grasp_id=f"{grasp.grasp_id}-{turn}", photo_file=file)
                images.grasps.append(named)
                images.rig_grasps[named.grasp_id] = known[grasp.grasp_id]
    return images


def references(start: Checkpoint, images: TrainingImages, cache: Path) -> References:
    """Return the partial activations of the rig's images by the start model, for each training image."""
    rig = list({grasp.grasp_id: grasp for grasp in images.rig_grasps.values()}.values())
    features = encode_recording(rig, start.matcher, start.config, cache)
    touches, photos = distil.feature_partials(start.matcher, features)
    of_grasp = dict(zip((grasp.grasp_id for grasp in rig), touches, strict=True))
    of_photo = dict(zip((grasp.photo for grasp in rig), photos, strict=True))
    return {
        **{name: of_grasp[grasp.grasp_id] for name, grasp in images.rig_grasps.items()},
        **{file: of_photo[photo] for file, photo in images.rig_photos.items()},
    }


def calibration_grasps(folder: Path, name: str) -> list[Grasp]:
    """Return the grasps of one of CALIBRATED."""
    recordings = (folder / CALIBRATION / name / part.name for part in CALIBRATED[name])
    return [grasp for recording in recordings for grasp in load_grasps(recording)]


def grasps_by_object(grasps: Iterable[Grasp]) -> dict[str, list[Grasp]]:
    """Return the grasps of each object."""
    found: dict[str, list[Grasp]] = {}
    for grasp in grasps:
        found.setdefault(grasp.object_id, []).append(grasp)
    return found


def photos_by_object(recording: Path) -> dict[str, list[Path]]:
    """Return the varied photos of each object of a recording."""
    files: dict[str, list[Path]] = {}
    for picture in load_pictures(varied_photos(recording)):
        files.setdefault(picture.object_id, []).append(picture.file)
    return files


def recording_of(folder: Path, part: Part) -> Path:
    """Return the folder of a recording for training."""
    return folder / RECORDINGS / part.name


def varied_photos(recording: Path) -> Path:
    """Return the folder of the varied photos of a recording's objects."""
    return recording.with_name(f"{recording.name}-photos")


def with_parts(made: Checkpoint, trained: Checkpoint, names: Iterable[str]) -> Checkpoint:
    """Return a checkpoint with these parts of another matcher; it states the training of these."""
    for name in names:
        getattr(made.matcher, name).load_state_dict(getattr(trained.matcher, name).state_dict())
    training = made.config.training.with_iterations(trained.config.training.iterations)
    return dataclasses.replace(
        made,
        config=dataclasses.replace(made.config, training=training),
        provenance=made.provenance | trained.provenance,
        split=trained.split,
    )


def of_fingers(grasps: Iterable[Grasp], fingers: int) -> list[Grasp]:
    """Return the grasps with the images of the first fingers only."""
    return [
        dataclasses.replace(each, touches=each.touches[:fingers], backgrounds=each.backgrounds[:fingers])
        for each in grasps
    ]


def split_of(train: list[Grasp], validation: list[Grasp]) -> Split:
    """Return the split of training and validation grasps."""
    return Split(0, *(tuple(sorted({grasp.object_id for grasp in part})) for part in (train, validation, [])))


def collect_training(arguments: argparse.Namespace) -> int:
    """Collect the training recordings, those by other sensors, and varied photos of the objects."""
    folder = arguments.folder
    if code := collect_parts(arguments, (*CELL_PARTS, *OTHER_SENSORS), folder / RECORDINGS, mesh_files(arguments)[0]):
        return code
    for part in CELL_PARTS:
        collect_varied_photos(arguments, part, recording_of(folder, part))
    return 0


def collect_calibration(arguments: argparse.Namespace) -> int:
    """Collect the recordings of CALIBRATED."""
    meshes = mesh_files(arguments)[1]
    for name, parts in CALIBRATED.items():
        if code := collect_parts(arguments, parts, arguments.folder / CALIBRATION / name, meshes):
            return code
    for part in CALIBRATED["varied_gels"]:
        collect_varied_photos(arguments, part, arguments.folder / CALIBRATION / "varied_gels" / part.name)
    return 0


def collect_varied_photos(arguments: argparse.Namespace, part: Part, recording: Path) -> None:
    """Photograph the objects of a recording with other cameras, on other grounds and with faults."""
    rig, photos = str(rig_file(arguments.folder, part)), varied_photos(recording)
    collect_pictures("varied", photos, objects=part.objects, seed=part.seed, rig=rig, jobs=arguments.jobs)


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
        if code := collect(out / part.name, rig, part.objects, part.grasps, part.seed, jobs):
            return code
    return 0


def write_rig(folder: Path, part: Part, meshes: Iterator[Path]) -> Path:
    """Write the rig of a recording, with the next of the meshes in random sizes, and return its file."""
    rig = rig_file(folder, part)
    settings: dict[str, Any] = {"rig": "sim", "gels": part.gels, "optics": part.optics}
    if part.has_meshes:
        settings["meshes"] = str(vary_meshes(meshes, part.objects, folder / "meshes" / part.name, part.seed))
    rig.write_text("".join(f"{key} = {json.dumps(value)}\n" for key, value in settings.items()))
    return rig


def rig_file(folder: Path, part: Part) -> Path:
    """Return the file of the rig of a recording."""
    return folder / f"{part.name}.toml"


def calibrate_shipped(arguments: argparse.Namespace) -> int:
    """Calibrate both shipped checkpoints again: posterior, gel check, references, openings, bounds of verifications."""
    if code := collect_calibration(arguments):
        return code
    for fingers, name in SHIPPED.items():
        shipped = load_checkpoint(shipped_model(fingers))
        store(calibrated(shipped, arguments.folder, fingers), arguments.folder / name)
    return 0


def calibrated(made: Checkpoint, folder: Path, fingers: int) -> Checkpoint:
    """Return a checkpoint with its gel check, posterior, calibration of reference touches, bounds and queries."""
    parts = [calibration_grasps(folder, name) for name in CALIBRATED]
    parts[-1] = with_varied_photos(folder, parts[-1])
    validation, verification, gels, varied = (of_fingers(part, fingers) for part in parts)
    every, device = [*validation, *verification, *gels, *varied], default_device()
    features = encode_recording(every, made.matcher, made.config, folder / "features")
    source = FrozenFeatures(features_by_image(every, features, device))
    names = sorted({grasp.object_id for grasp in gels})
    fitting, others = ([grasp for grasp in gels if grasp.object_id in names[side::2]] for side in (0, 1))
    held_out = [*validation, *others]
    made = calibrate_checkpoint(
        made,
        source,
        [*fitting, *varied],
        held_out,
        foreign=FOREIGN,
        max_grasps=len(every),
    )
    touches, _ = recorded_features(made.matcher, source, validation)
    with torch.inference_mode():
        queries = distil.select_queries(made.matcher.touch_encoding(touches).partial, seed=0)
    touches, photos = recorded_features(made.matcher, source, verification)
    trials = score_grasps(made.matcher, verification, touches, photos)
    assert trials is not None
    assert made.posterior is not None
    refused = [refused_touches(made, touches)]
    bounds = fit_verification([trials], made.posterior, refused=refused)
    assert made.split is not None
    split = dataclasses.replace(made.split, validation=split_of([], validation).validation)
    return dataclasses.replace(made, verification=bounds, queries=queries, split=split)


def with_varied_photos(folder: Path, grasps: Sequence[Grasp]) -> list[Grasp]:
    """Return the grasps that only fit the gel check, each with a varied photo of its object."""
    recordings = (folder / CALIBRATION / "varied_gels" / part.name for part in CALIBRATED["varied_gels"])
    photos = {name: files for recording in recordings for name, files in photos_by_object(recording).items()}
    return [dataclasses.replace(grasp, photo_file=photos[grasp.object_id][0]) for grasp in grasps]


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
    model, out = arguments.model or shipped_model(), arguments.folder / "report"
    return retrieve("evaluate", recording, "--model", model, "--methods", "chance", "--split", split, "--out", out)


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
