"""The checkpoints of the package: their training, and their accuracy on unseen objects.

    python -m models.shipped make FOLDER --meshes MESHES
        collect grasps of procedural objects and of meshes on simulated rigs, and photos of them by other cameras, on
        other grounds and with faults; train the shipped towers further, and a head for two fingers and one for one
        finger; calibrate both, and store them in FOLDER
    python -m models.shipped calibrate FOLDER
        calibrate the shipped checkpoints again; keep their weights
    python -m models.shipped score FOLDER
        collect other objects into FOLDER/recording, and evaluate the shipped checkpoint on them: FOLDER/report; with
        --fingers 1 that for one finger, in FOLDER/report-one-finger

An interrupted job continues. Accuracy on simulated touches does not predict accuracy on real sensors.
"""

import argparse
import dataclasses
import itertools
import json
import sys
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from models.labels import LabelTrainer
from models.meshes import vary_meshes
from models.pictures import collect_pictures, load_object_labels, load_pictures
from retrieval.commands.main import main as run_command
from retrieval.console.memory import keep_freed_memory
from retrieval.data.dataset import LICENCES, Grasp, Split, data_digest, load_grasps
from retrieval.methods.late_fusion import frozen_matcher, trained_checkpoint
from retrieval.methods.method import MethodSettings
from retrieval.model.card import SHIPPED_DATA
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint, write_tensors
from retrieval.model.config import Config, load_config
from retrieval.model.encode import default_device, one_thread
from retrieval.model.shipped import SHIPPED, shipped_model
from retrieval.training import distil
from retrieval.training.calibration import calibrate_checkpoint, fit_verification, score_grasps
from retrieval.training.features import Features, FrozenFeatures, encode_recording, features_by_image, recorded_features

RIGS = Path(__file__).parent
RIG, GELS_RIG = (RIGS / f"shipped_{name}.toml" for name in ("rig", "gels"))


class Part(NamedTuple):
    """Rigs of training grasps, one for each seed: optics of its gels, and its objects, procedural or meshes."""

    optics: str
    has_meshes: bool
    first_seed: int
    seeds: int
    objects: int


PARTS = (
    Part("led", False, 113_000, 6, 250),
    Part("varied", False, 123_000, 6, 200),
    Part("gelsight", False, 124_000, 1, 250),
    Part("gelsight_mini", False, 125_000, 1, 250),
    Part("led", True, 126_000, 3, 260),
    Part("varied", True, 127_000, 2, 260),
)
RECORDINGS, CALIBRATION = "recordings", "calibration"
"""Folders of the recordings."""
GELS_OF_RIG = 4
"""Pairs of gels of a training rig: with more, it computes the properties of a gel again for nearly every object."""
SEED_VALIDATED, SEED_VERIFIED, SEED_GELS, SEED_SCORED = 150_000, 130_000, 140_000, 30_000
"""Seeds of other object sets. The demo has its own (retrieval.commands.demo.SEED), the benchmark has 0."""
TOWERS, HEADS = RIGS / "shipped_towers.toml", RIGS / "shipped_heads.toml"
"""Configurations of the training of the towers and of the heads. The last step of the towers is used: the head that is
trained together with them does not tell which step has the best towers."""
GRASPS, VALIDATED, VERIFIED, GELS = 2, (100, 8), (150, 5), (400, 2)
"""Grasps of each training object; objects that choose the step and calibrate the model, and grasps of each; objects on
which the bounds of verifications are fitted, and grasps of each; further objects for the check of gel images, and
grasps of each."""
HEAD_STEPS = 1000
FOREIGN = 8000
"""Number of non-gel pictures for training its check of touches: more than in an ordinary training."""
DISTIL_STEPS = 4000
"""Training steps of its candidate encoder, more than the preset's: it is trained once and used by everyone."""
FITTED = 10
"""Scored objects for calibration, and as many training objects for other fits; the rest are the test set."""


def main(argv: list[str] | None = None) -> int:
    """Run one of the jobs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    jobs = parser.add_subparsers(dest="job", required=True)
    make = jobs.add_parser("make", help="collect and train the checkpoints that come with the package")
    make.add_argument("--meshes", type=Path, required=True, help="folder of closed meshes (STL)")
    calibrate_job = jobs.add_parser("calibrate", help="calibrate the shipped checkpoints again; keep their weights")
    score = jobs.add_parser("score", help="evaluate a checkpoint on other objects")
    score.add_argument("--objects", type=int, default=120)
    score.add_argument("--grasps", type=int, default=8)
    score.add_argument("--model", type=Path, help="another checkpoint than the shipped one")
    score.add_argument("--fingers", type=int, choices=tuple(SHIPPED), default=2, help="gel images of a touch")
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


class Trained(NamedTuple):
    """Trained towers, as a configuration of heads, and the training and validation grasps with their features."""

    folder: Path
    config: Config
    grasps: tuple[list[Grasp], list[Grasp]]
    features: tuple[Features, Features]


def train_towers(folder: Path, **settings: Any) -> Trained:
    """Train both towers further, with the head of two fingers; `settings` change those of TOWERS."""
    parts = sorted((folder / RECORDINGS).iterdir())
    train = [grasp for part in parts for grasp in grasps_with_varied_photos(part)]
    validation = grasps_with_varied_photos(folder / CALIBRATION / "validation")
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
    config = head_config(folder, trainer.run_or_reuse(quiet=False))
    features, validated = (
        encode_recording(grasps, frozen_matcher(config), config, folder / "features") for grasps in (train, validation)
    )
    return Trained(folder, config, (train, validation), (features, validated))


def grasps_with_varied_photos(recording: Path) -> list[Grasp]:
    """Return the grasps of a recording, each with its own photo or a varied one of the object, all equally likely."""
    varied: dict[str, list[Path]] = {}
    for picture in load_pictures(varied_photos(recording)):
        varied.setdefault(picture.object_id, []).append(picture.file)
    grasps = []
    for grasp in load_grasps(recording):
        choices = [grasp.photo, *varied[grasp.object_id]]
        drawn = np.random.default_rng(zlib.crc32(grasp.grasp_id.encode())).integers(len(choices))
        grasps.append(dataclasses.replace(grasp, photo_file=choices[drawn]))
    return grasps


def varied_photos(recording: Path) -> Path:
    """Return the folder of the varied photos of a recording's objects, next to it."""
    return recording.parent.parent / "photos" / recording.name


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
    """Train a head on the features of the towers, for its number of fingers."""
    folder = trained.folder / f"{trained.config.matcher.fingers}-fingers"
    settings = MethodSettings(trained.config, folder=folder, quiet=False)
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
    """Collect the training grasps, one recording for each seed, and varied photos of their objects."""
    folder, jobs = arguments.folder, arguments.jobs
    folder.mkdir(parents=True, exist_ok=True)
    meshes = itertools.cycle(sorted(arguments.meshes.glob("*.stl")))
    for optics, has_meshes, first_seed, seeds, objects in PARTS:
        for seed in range(first_seed, first_seed + seeds):
            settings: dict[str, Any] = {"rig": "sim", "gels": GELS_OF_RIG, "optics": optics}
            if has_meshes:
                settings["meshes"] = str(vary_meshes(meshes, objects, folder / "meshes" / str(seed), seed))
            rig = folder / f"{seed}.toml"
            rig.write_text("".join(f"{key} = {json.dumps(value)}\n" for key, value in settings.items()))
            out = folder / RECORDINGS / str(seed)
            if code := collect(out, rig, objects, GRASPS, seed, jobs):
                return code
            collect_pictures("varied", varied_photos(out), objects=objects, seed=seed, rig=str(rig), jobs=jobs)
    return 0


def collect_calibration(arguments: argparse.Namespace) -> int:
    """Collect the grasps of the validation objects, and those that `calibrated` needs besides."""
    folder, jobs = arguments.folder / CALIBRATION, arguments.jobs
    for name, rig, (objects, grasps), seed in (
        ("validation", RIG, VALIDATED, SEED_VALIDATED),
        ("verification", RIG, VERIFIED, SEED_VERIFIED),
        ("gels", GELS_RIG, GELS, SEED_GELS),
    ):
        if code := collect(folder / name, rig, objects, grasps, seed, jobs):
            return code
        collect_pictures("varied", varied_photos(folder / name), objects=objects, seed=seed, rig=str(rig), jobs=jobs)
    return 0


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
    parts = [grasps_with_varied_photos(folder / CALIBRATION / name) for name in ("validation", "verification", "gels")]
    if fingers == 1:
        parts = [[each_finger(grasp)[0] for grasp in part] for part in parts]
    validation, verification, gels = parts
    every, device = [*validation, *verification, *gels], default_device()
    features = encode_recording(every, made.matcher, made.config, folder / "features")
    source = FrozenFeatures(made.config, features_by_image(every, features, device))
    known = [*verification, *gels]
    made = calibrate_checkpoint(made, source, known, validation, foreign=FOREIGN, max_grasps=len(every))
    touches, photos = recorded_features(made.matcher, source, verification)
    trials = score_grasps(made.matcher, verification, touches, photos)
    assert trials is not None
    assert made.posterior is not None
    return dataclasses.replace(made, verification=fit_verification([trials], made.posterior))


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
