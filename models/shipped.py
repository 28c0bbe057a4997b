"""The checkpoints of the package: their training, and their accuracy on unseen objects.

    python -m models.shipped make FOLDER --init WEIGHTS
        collect grasps on simulated rigs, photos and presses of other objects; pretrain both towers on relief, train
        them together in three rounds, train a head for two fingers and one for one finger, calibrate both, and store
        them in FOLDER
    python -m models.shipped calibrate FOLDER
        calibrate the shipped checkpoints again; keep their weights
    python -m models.shipped score FOLDER
        collect other objects into FOLDER/recording, and evaluate the shipped checkpoint on them: FOLDER/report; with
        --fingers 1 that for one finger, in FOLDER/report-one-finger

An interrupted job continues. Accuracy on simulated touches does not predict accuracy on real sensors.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from models.labels import LabelTrainer
from models.pictures import collect_pictures, load_object_labels
from models.relief import pretrain
from retrieval.commands.main import main as run_command
from retrieval.console.memory import keep_freed_memory
from retrieval.console.output import say
from retrieval.data.dataset import Grasp, Split, data_digest, load_grasps
from retrieval.methods.late_fusion import frozen_matcher, trained_checkpoint
from retrieval.methods.method import MethodSettings
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint, write_tensors
from retrieval.model.config import Config, load_config
from retrieval.model.encode import default_device, one_thread
from retrieval.model.shipped import SHIPPED, shipped_model
from retrieval.training import distil
from retrieval.training.calibration import calibrate_checkpoint, fit_verification, score_grasps
from retrieval.training.features import Features, FrozenFeatures, encode_recording, features_by_image, recorded_features

RIGS = Path(__file__).parent
RIG, TOUCH_RIG, GELS_RIG = (RIGS / f"shipped_{name}.toml" for name in ("rig", "touches", "gels"))
ROUNDS = (
    {"shipped_training.toml": (112_000, 20, 400), "shipped_varied.toml": (122_000, 5, 120)},
    {"shipped_training.toml": (112_020, 15, 400), "shipped_varied.toml": (122_010, 1, 150)},
    {"shipped_training.toml": (112_035, 15, 400), "shipped_varied.toml": (122_011, 1, 150)},
)
"""Rigs of the training grasps that each round adds: the first seed, the number of seeds, and the objects of each seed,
which has its own gels."""
TRAINED_ON = ((0,), (1,), (1, 2))
"""Rounds whose training grasps each round uses."""
SEED_VALIDATED, SEED_VERIFIED, SEED_GELS, SEED_SCORED = 150_000, 130_000, 140_000, 30_000
"""Seeds of other object sets. The demo has its own (retrieval.commands.demo.SEED), the benchmark has 0."""
SEED_PHOTOS, SEED_TOUCHES = 60_000, 61_000
TOWERS, HEADS = RIGS / "shipped_towers.toml", RIGS / "shipped_heads.toml"
"""Configurations of the training of the towers and of the heads."""
LATER_ROUND = {"learning_rate": 1e-3, "tower_rate": 0.5}
LATER_STEPS = 800, 1100
"""Settings and steps of the towers' later rounds. Each starts from the towers and the head of the round
before. The last step is used: the head that is trained together with the towers does not tell which step has the best
towers."""
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
    make.add_argument("--init", type=Path, required=True, help="state dict of MobileNetV2, torchvision's key names")
    make.add_argument("--photos", type=int, default=10_000, help="number of photo-only objects")
    make.add_argument("--touches", type=int, default=9_361, help="number of touch-only objects")
    make.add_argument("--steps", type=int, default=2500, help="steps of pretraining each tower on relief")
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
    pretrain_towers(arguments)
    files = {f"init_{side}": str(folder / f"{side}-tower.safetensors") for side in ("photo", "touch")}
    last = train_round(folder, 0, files)
    for number, steps in enumerate(LATER_STEPS, start=1):
        start = {"start": str(train_head(for_fingers(last, 2)).path)}
        last = train_round(folder, number, start | LATER_ROUND | {"iterations": steps, "validate_every": steps})
    for fingers, name in SHIPPED.items():
        trained = for_fingers(last, fingers)
        made = distilled(train_head(trained), *trained.features)
        if made.queries is not None:  # the file stays below 12 MB
            made = dataclasses.replace(made, queries=made.queries[::2])
        store(calibrated(made, folder, fingers), folder / name)
    return 0


class Round(NamedTuple):
    """Trained towers, as a configuration of heads, and the training and validation grasps with their features."""

    folder: Path
    config: Config
    grasps: tuple[list[Grasp], list[Grasp]]
    features: tuple[Features, Features]


def train_round(folder: Path, number: int, settings: Mapping[str, Any]) -> Round:
    """Train both towers on the recordings of one round; `settings` are its changes of TOWERS."""
    out = folder / f"round-{number}"
    parts = [
        part for each in TRAINED_ON[number] for part in sorted((folder / f"round-{each}" / "recordings").iterdir())
    ]
    train, validation = [grasp for part in parts for grasp in load_grasps(part)], load_grasps(folder / "validation")
    config = head_config(out, train_towers(out, settings, parts, train, validation))
    features, validated = (
        encode_recording(each, frozen_matcher(config), config, out / "features") for each in (train, validation)
    )
    return Round(out, config, (train, validation), (features, validated))


def train_towers(
    folder: Path, settings: Mapping[str, Any], parts: Sequence[Path], train: list[Grasp], validation: list[Grasp]
) -> Checkpoint:
    """Train both towers, with the head of two fingers.

    Args:
        folder: Folder of the result.
        settings: Changes of the settings, with the initial weights.
        parts: The recordings, which have the labels of the training objects.
        train: Their grasps.
        validation: Grasps that choose the step.
    """
    config = load_config(TOWERS)
    training = dataclasses.replace(config.training, **settings)
    labels = {name: each for part in parts for name, each in load_object_labels(part).items()}
    done = folder / "towers.safetensors"
    trainer = LabelTrainer(
        dataclasses.replace(config, training=training),
        split_of(train, validation),
        [*train, *validation],
        done,
        source="simulated rigs",
        labels=labels,
    )
    return trainer.run_or_reuse(quiet=False)


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


def train_head(trained: Round) -> Checkpoint:
    """Train a head on the features of a round, for its number of fingers."""
    folder = trained.folder / f"{trained.config.matcher.fingers}-fingers"
    settings = MethodSettings(trained.config, folder=folder, quiet=False)
    made = trained_checkpoint(settings, *trained.features)
    train, validation = trained.grasps
    about = {"source": "simulated rigs", "data_digest": data_digest([*train, *validation])}
    return dataclasses.replace(made, provenance=made.provenance | about, split=split_of(train, validation))


def for_fingers(trained: Round, fingers: int) -> Round:
    """Return the round for heads of one finger, whose grasps are the touches of each finger, or of two."""
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
    """Collect the training grasps, one recording for each seed."""
    for number, rigs in enumerate(ROUNDS):
        for rig, (first, seeds, objects) in rigs.items():
            for seed in range(first, first + seeds):
                out = arguments.folder / f"round-{number}" / "recordings" / str(seed)
                if code := collect(out, RIGS / rig, objects, GRASPS, seed, arguments.jobs):
                    return code
    return 0


def collect_calibration(arguments: argparse.Namespace) -> int:
    """Collect the grasps of the validation objects, and those that `calibrated` needs besides."""
    folder, jobs = arguments.folder, arguments.jobs
    return (
        collect(folder / "validation", RIG, *VALIDATED, SEED_VALIDATED, jobs)
        or collect(folder / "verification", RIG, *VERIFIED, SEED_VERIFIED, jobs)
        or collect(folder / "gels", GELS_RIG, *GELS, SEED_GELS, jobs)
    )


def pretrain_towers(arguments: argparse.Namespace) -> None:
    """Photograph and press objects of two other seeds, and pretrain each tower on relief with them."""
    heads = load_config(HEADS)
    config = dataclasses.replace(heads, training=dataclasses.replace(heads.training, init=str(arguments.init)))
    for kind, objects, seed, rig in (
        ("photo", arguments.photos, SEED_PHOTOS, "sim"),
        ("touch", arguments.touches, SEED_TOUCHES, str(TOUCH_RIG)),
    ):
        tower = arguments.folder / f"{kind}-tower.safetensors"
        if not tower.exists():
            folder = arguments.folder / f"{kind}-pictures"
            pictures = collect_pictures(kind, folder, objects=objects, seed=seed, rig=rig, jobs=arguments.jobs)
            say(pretrain(kind, pictures, tower, config, arguments.steps))


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
    parts = [load_grasps(folder / name) for name in ("validation", "verification", "gels")]
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
    """Write a checkpoint as float16, without the paths of its first weights on this machine."""
    training = dataclasses.replace(made.config.training, init="imagenet", init_photo="", init_touch="")
    made = dataclasses.replace(made, config=dataclasses.replace(made.config, training=training))
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
