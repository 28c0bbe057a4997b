"""The checkpoints of the package: their training, and their accuracy on unseen objects.

    python -m benchmarks.models.shipped make FOLDER --init WEIGHTS
        simulate photos and presses of objects and pretrain both towers on relief; simulate grasps of other objects, by
        gels with the optics of a GelSight and of any make; train the matcher on these towers, and store it as float16
        in FOLDER/simulated-mobilenet.safetensors; with --fingers 1 one for touches of one gel image, of the same grasps
    python -m benchmarks.models.shipped score FOLDER
        collect other objects into FOLDER/recording, and evaluate the shipped checkpoint on them: FOLDER/report; with
        --fingers 1 that for one finger, in FOLDER/report-one-finger

`make` continues an interrupted run. Accuracy on simulated touches does not predict accuracy on real sensors.
"""

import argparse
import dataclasses
import json
import sys
from pathlib import Path

import numpy as np

from retrieval.commands.main import main as run_command
from retrieval.data.dataset import Grasp, Split, load_grasps, recording_source
from retrieval.model.checkpoint import Checkpoint, store_checkpoint
from retrieval.model.config import Config, load_config
from retrieval.search import defaults
from retrieval.training.state import finish_training, unfinished_path
from retrieval.training.train import Trainer

# Seeds of the simulated rig. The demo has its own (retrieval.commands.demo.SEED), the benchmark has 0.
SEED_TRAINED, SEED_VARIED, SEED_VALIDATION, SEED_SCORED = 110_000, 120_000, 130_000, 30_000
SEED_PHOTOS, SEED_TOUCHES = 60_000, 61_000
RIG, VARIED_RIG, TOUCH_RIG = (
    Path(__file__).with_name(name) for name in ("shipped_rig.toml", "shipped_varied_rig.toml", "shipped_touches.toml")
)
PRESET = "relief-large"
PRETRAINING_PRESET = "relief"
VALIDATION, VALIDATION_GRASPS = 150, 5
"""Objects that choose the checkpoint and calibrate it, and grasps of each."""
OBJECTS, VARIED, ITERATIONS = 4700, 4000, 1500
DISTIL_STEPS = 2000
"""Training steps of its candidate encoder, more than the preset's: it is trained once and used by everyone."""
FOREIGN = 8000
"""Number of non-gel pictures for training its check of touches: more than in an ordinary training."""
FITTED = 10
"""Number of validation objects, and of training objects, among the scored ones; the others are the test set."""


def main(argv: list[str] | None = None) -> int:
    """Run one of the jobs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    jobs = parser.add_subparsers(dest="job", required=True)
    make = jobs.add_parser("make", help="collect and train the checkpoint that comes with the package")
    make.add_argument("folder", type=Path)
    make.add_argument("--init", type=Path, required=True, help="state dict of MobileNetV2, torchvision's key names")
    make.add_argument("--objects", type=int, default=OBJECTS, help="objects touched by gels with GelSight optics")
    make.add_argument("--varied", type=int, default=VARIED, help="objects touched by gels with optics of any make")
    make.add_argument("--grasps", type=int, default=3, help="grasps of each of them")
    make.add_argument("--photos", type=int, default=10_000, help="number of photo-only objects")
    make.add_argument("--touches", type=int, default=9_361, help="number of touch-only objects")
    make.add_argument("--steps", type=int, default=2500, help="steps of pretraining each tower on relief")
    make.add_argument("--iterations", type=int, default=ITERATIONS, help="iterations of training the matcher")
    score = jobs.add_parser("score", help="evaluate it on other objects")
    score.add_argument("folder", type=Path)
    score.add_argument("--objects", type=int, default=120)
    score.add_argument("--grasps", type=int, default=8)
    score.add_argument("--model", type=Path, help="another checkpoint than the shipped one")
    for job in (make, score):
        job.add_argument(
            "--fingers", type=int, choices=tuple(defaults.SHIPPED), default=2, help="gel images of a touch"
        )
        job.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args(argv)
    return make_shipped(arguments) if arguments.job == "make" else score_shipped(arguments)


def make_shipped(arguments: argparse.Namespace) -> int:
    """Collect, pretrain the towers and train; continue an interrupted run."""
    if code := pretrain_towers(arguments) or collect_trained(arguments):
        return code
    store(trained(arguments), arguments.folder / defaults.SHIPPED[arguments.fingers])
    return 0


def trained(arguments: argparse.Namespace) -> Checkpoint:
    """Train a matcher on the frozen, pretrained towers."""
    folder, fingers, config = arguments.folder, arguments.fingers, load_config(PRESET)
    training = dataclasses.replace(
        config.training.with_iterations(arguments.iterations),
        init=str(arguments.init),
        init_touch=str(folder / "touch-tower.safetensors"),
        init_photo=str(folder / "photo-tower.safetensors"),
        distil_steps=DISTIL_STEPS,
    )
    config = Config(dataclasses.replace(config.matcher, fingers=fingers), training, config.preprocessing)
    recordings = [folder / name for name in ("touched", "varied", "validation")]
    parts = [load_grasps(recording) for recording in recordings]
    if fingers == 1:
        parts = [[one for grasp in part for one in each_finger(grasp)] for part in parts]
    names = [sorted({grasp.object_id for grasp in part}) for part in parts]
    split = Split(0, train=tuple(sorted(names[0] + names[1])), validation=tuple(names[2]), test=())
    grasps = [grasp for part in parts for grasp in part]
    out = folder / f"trained-{fingers}-fingers.safetensors"
    trainer = Trainer(config, split, grasps, unfinished_path(out), recording_source(recordings[0]))
    # Frozen towers have not seen gels of any make: among these, every tenth foreign picture would pass as a gel image.
    trainer.foreign_pictures, trainer.checked_grasps = FOREIGN, parts[0]
    return finish_training(trainer, out, quiet=False)


def collect_trained(arguments: argparse.Namespace) -> int:
    """Collect the grasps of training and validation objects."""
    for name, rig, objects, grasps, seed in (
        ("touched", RIG, arguments.objects, arguments.grasps, SEED_TRAINED),
        ("varied", VARIED_RIG, arguments.varied, arguments.grasps, SEED_VARIED),
        ("validation", RIG, VALIDATION, VALIDATION_GRASPS, SEED_VALIDATION),
    ):
        size = ("--objects", objects, "--grasps", grasps, "--seed", seed, "--jobs", arguments.jobs)
        if code := retrieve("collect", "--rig", rig, *size, "--out", arguments.folder / name):
            return code
    return 0


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


def pretrain_towers(arguments: argparse.Namespace) -> int:
    """Photograph and press objects of two other seeds, and pretrain each tower on relief with them."""
    for side, pictures, seed, rig in (
        ("photo", "photos", SEED_PHOTOS, "sim"),
        ("touch", "touches", SEED_TOUCHES, TOUCH_RIG),
    ):
        folder, tower = arguments.folder / pictures, arguments.folder / f"{side}-tower.safetensors"
        if tower.exists():
            continue
        size = ("--objects", getattr(arguments, pictures), "--seed", seed, "--jobs", arguments.jobs)
        options = ("--config", PRETRAINING_PRESET, "--init", arguments.init, "--iterations", arguments.steps)
        code = retrieve("collect", f"--{pictures}-only", "--rig", rig, *size, "--out", folder) or retrieve(
            "train", folder, "--task", "relief", *options, "--out", tower
        )
        if code:
            return code
    return 0


def store(made: Checkpoint, out: Path) -> None:
    """Write a checkpoint as float16, without the paths of its first weights on this machine, in less than 12 MB."""
    training = dataclasses.replace(
        made.config.training, init="imagenet", init_photo="", init_touch="", photos="", touches=""
    )
    queries = None if made.queries is None else made.queries[::2]
    made = dataclasses.replace(made, config=dataclasses.replace(made.config, training=training), queries=queries)
    store_checkpoint(made, out, float16=True)


def score_shipped(arguments: argparse.Namespace) -> int:
    """Write the whole report on objects of another seed, touched by other gels."""
    recording = arguments.folder / "recording"
    if code := collect(recording, arguments, SEED_SCORED):
        return code
    split = recording.with_name("split.json")
    split.write_text(json.dumps(draw_split(load_grasps(recording), FITTED, FITTED).to_dict(), indent=1) + "\n")
    model = arguments.model or defaults.shipped_model(arguments.fingers)
    methods = "late_fusion,retrieve_rerank,chance"
    out = arguments.folder / "report"
    if arguments.fingers == 1:
        recording, out = first_finger(recording), arguments.folder / "report-one-finger"
    return retrieve("evaluate", recording, "--model", model, "--methods", methods, "--split", split, "--out", out)


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


def draw_split(grasps: list[Grasp], train: int | None, validation: int) -> Split:
    """Split objects: `validation` for validation, `train` for training (None for all others), the rest for test."""
    names = sorted({grasp.object_id for grasp in grasps})
    names = [str(name) for name in np.random.default_rng(0).permutation(names)]
    validated, others = names[:validation], names[validation:]
    trained = others if train is None else others[:train]
    return Split(0, tuple(sorted(trained)), tuple(sorted(validated)), tuple(sorted(set(others) - set(trained))))


def collect(recording: Path, arguments: argparse.Namespace, seed: int) -> int:
    """Run `retrieve collect` on the simulated rig."""
    size = ("--objects", arguments.objects, "--grasps", arguments.grasps, "--seed", seed, "--jobs", arguments.jobs)
    return retrieve("collect", "--rig", RIG, *size, "--out", recording)


def retrieve(*arguments: object) -> int:
    """Print a command as a user would type it, and run it."""
    words = [str(argument) for argument in arguments]
    print("$ retrieve " + " ".join(words), file=sys.stderr, flush=True)
    return run_command(words)


if __name__ == "__main__":
    sys.exit(main())
