"""The checkpoint of the package: its training, and its accuracy on unseen objects.

    python -m benchmarks.models.shipped make FOLDER --init WEIGHTS
        collect grasps on the simulated rig, photos and presses of other objects, pretrain both towers on relief, train
        the matcher, and store it as float16 in FOLDER/simulated-mobilenet.safetensors; with --fingers 1 one for touches
        of one gel image, of the same grasps
    python -m benchmarks.models.shipped distil FOLDER
        retrain the candidate encoder of the shipped checkpoint, from the recording, pictures and features that `make`
        left in FOLDER; with --fingers 1 that of the one for one finger
    python -m benchmarks.models.shipped verdicts FOLDER
        fit the posterior and the gel check of the shipped checkpoint again, on its validation objects and as many
        training ones, collected into FOLDER/verdicts
    python -m benchmarks.models.shipped references FOLDER
        fit the calibration of reference touches of the shipped checkpoint, on its validation objects, collected into
        FOLDER/references; with --fingers 1 that of the one for one finger
    python -m benchmarks.models.shipped verification FOLDER
        fit the bounds of verifications of the shipped checkpoint, on objects that were not in training, collected into
        FOLDER/verification; with --fingers 1 those of the one for one finger
    python -m benchmarks.models.shipped score FOLDER
        collect other objects into FOLDER/recording, and evaluate the shipped checkpoint on them: FOLDER/report; with
        --fingers 1 that for one finger, in FOLDER/report-one-finger

Accuracy on simulated touches does not predict accuracy on real sensors.
"""

import argparse
import dataclasses
import functools
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import robot
from retrieval.commands.main import main as run_command
from retrieval.data.dataset import Grasp, Split, data_digest, load_grasps, recording_source
from retrieval.methods.late_fusion import frozen_matcher, trained_checkpoint
from retrieval.methods.method import MethodSettings
from retrieval.model.checkpoint import Checkpoint, load_checkpoint, store_checkpoint
from retrieval.model.checkpoint_info import PARTIALS_FROM
from retrieval.model.config import load_config
from retrieval.model.encode import default_device, one_thread
from retrieval.model.reference_calibration import ReferenceTouches, fit_reference_calibration
from retrieval.model.verification import fit_verification
from retrieval.search import defaults
from retrieval.training import distil
from retrieval.training.batches import FrozenFeatures, recorded_features
from retrieval.training.features import Features, encode_recording, features_by_image
from retrieval.training.train import labelled_pairs
from retrieval.training.verdicts import photo_embeddings, posterior_touches, with_verdicts

# Seeds of the simulated rig. The demo has its own (retrieval.commands.demo.SEED), the benchmark has 0.
SEED_TRAINED, SEED_SCORED = 10_000, 30_000
SEED_PHOTOS, SEED_TOUCHES = 60_000, 61_000
SEED_VERIFIED = 130_000
RIG, TOUCH_RIG = (Path(__file__).with_name(name) for name in ("shipped_rig.toml", "shipped_touches.toml"))
PRESET = "relief"
VALIDATION = 100
"""Number of objects that choose the checkpoint and calibrate it."""
VERDICT_GRASPS, REFERENCE_GRASPS = 4, 8
"""Grasps of each object for fitting the posterior and the gel check, and the calibration of references."""
VERIFIED, VERIFIED_GRASPS = 150, 5
"""Objects on which the bounds of verifications are fitted, and grasps of each. Unlike validation objects they chose no
training step."""
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
    make = jobs.add_parser("make", help="collect and train the checkpoint that comes with the package")
    make.add_argument("folder", type=Path)
    make.add_argument("--init", type=Path, required=True, help="state dict of MobileNetV2, torchvision's key names")
    make.add_argument("--objects", type=int, default=1380, help="number of touched objects")
    make.add_argument("--grasps", type=int, default=4, help="grasps of each of them")
    make.add_argument("--photos", type=int, default=10_000, help="number of photo-only objects")
    make.add_argument("--touches", type=int, default=9_361, help="number of touch-only objects")
    make.add_argument("--steps", type=int, default=2500, help="steps of pretraining each tower on relief")
    make.add_argument("--iterations", type=int, default=2500, help="iterations of training the head")
    distil_job = jobs.add_parser("distil", help="retrain only the candidate encoder of the shipped checkpoint")
    distil_job.add_argument("folder", type=Path)
    distil_job.add_argument("--steps", type=int, default=DISTIL_STEPS)
    verdicts = jobs.add_parser("verdicts", help="fit only its posterior and its gel check again")
    verdicts.add_argument("folder", type=Path)
    references = jobs.add_parser("references", help="fit only the calibration of reference touches")
    references.add_argument("folder", type=Path)
    verification = jobs.add_parser("verification", help="fit only the bounds of verifications")
    verification.add_argument("folder", type=Path)
    score = jobs.add_parser("score", help="evaluate it on other objects")
    score.add_argument("folder", type=Path)
    score.add_argument("--objects", type=int, default=120)
    score.add_argument("--grasps", type=int, default=8)
    score.add_argument("--model", type=Path, help="another checkpoint than the shipped one")
    for job in (make, distil_job, references, verification, score):
        job.add_argument(
            "--fingers", type=int, choices=tuple(defaults.SHIPPED), default=2, help="gel images of a touch"
        )
    for job in (make, verdicts, references, verification, score):
        job.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args(argv)
    run = {
        "make": make_shipped,
        "distil": distil_shipped,
        "verdicts": calibrate_shipped,
        "references": calibrate_posterior,
        "verification": calibrate_verification,
        "score": score_shipped,
    }
    return run[arguments.job](arguments)


def make_shipped(arguments: argparse.Namespace) -> int:
    """Collect, encode and train; continue an interrupted run."""
    folder = arguments.folder
    recording = folder / "recording"
    code = collect(recording, arguments, SEED_TRAINED) or pretrain_towers(arguments)
    if code:
        return code
    config = load_config(PRESET)
    training = dataclasses.replace(
        config.training.with_iterations(arguments.iterations),
        init=str(arguments.init),
        init_photo=str(folder / "photo-tower.safetensors"),
        init_touch=str(folder / "touch-tower.safetensors"),
        photos=str(folder / "photos"),
        touches=str(folder / "touches"),
    )
    matcher = dataclasses.replace(config.matcher, fingers=arguments.fingers)
    config = dataclasses.replace(config, matcher=matcher, training=training)
    grasps, towers = load_grasps(recording), frozen_matcher(config)
    if arguments.fingers == 1:
        grasps = [each for grasp in grasps for each in each_finger(grasp)]
    features, pairs = (
        encode_recording(each, towers, config, folder / "features") for each in (grasps, labelled_pairs(config))
    )
    split = draw_split(grasps, train=None, validation=VALIDATION)
    train, validation = features.of_objects(split.train).concatenate(pairs), features.of_objects(split.validation)
    trained = folder / f"{arguments.fingers}-fingers"
    checkpoint = trained_checkpoint(MethodSettings(config, folder=trained, quiet=False), train, validation)
    about = {"source": recording_source(recording), "data_digest": data_digest(grasps), "pairs": len(pairs)}
    # The split excludes its training objects from evaluations; no recording contains the pairs.
    checkpoint = dataclasses.replace(checkpoint, provenance=checkpoint.provenance | about, split=split)
    checkpoint = distilled(checkpoint, train, validation, DISTIL_STEPS)
    store(fit_calibration(checkpoint, grasps, features), folder / defaults.SHIPPED[arguments.fingers])
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
        size = ("--objects", getattr(arguments, pictures), "--seed", seed, "--jobs", arguments.jobs)
        code = retrieve("collect", f"--{pictures}-only", "--rig", rig, *size, "--out", folder)
        if not code and not tower.exists():
            options = ("--config", PRESET, "--init", arguments.init, "--iterations", arguments.steps)
            code = retrieve("train", folder, "--task", "relief", *options, "--out", tower)
        if code:
            return code
    return 0


def calibrate_shipped(arguments: argparse.Namespace) -> int:
    """Fit posterior and gel check; keep all weights. Collect only the needed objects of the recording of `make`."""
    shipped = load_checkpoint(defaults.shipped_model())
    assert shipped.split is not None
    names = sorted({*shipped.split.validation, *shipped.split.train[:: len(shipped.split.train) // VALIDATION]})
    grasps = collect_of(arguments.folder / "verdicts", names, VERDICT_GRASPS, arguments.jobs)
    features = encode_recording(grasps, shipped.matcher, shipped.config, arguments.folder / "features")
    store(fit_calibration(shipped, grasps, features), arguments.folder / defaults.SHIPPED[2])
    return 0


def calibrate_posterior(arguments: argparse.Namespace) -> int:
    """Fit the calibration of reference touches; keep all weights and the posterior."""
    shipped = load_checkpoint(defaults.shipped_model(arguments.fingers))
    assert shipped.split is not None
    names = shipped.split.validation
    grasps = collect_of(arguments.folder / "references", names, REFERENCE_GRASPS, arguments.jobs)
    if arguments.fingers == 1:
        grasps = [each_finger(grasp)[0] for grasp in grasps]
    trials, _ = scored_touches(shipped, grasps, arguments.folder / "features")
    calibrated = same_codes(dataclasses.replace(shipped, references=fit_reference_calibration(trials)), shipped)
    store(calibrated, arguments.folder / defaults.SHIPPED[arguments.fingers])
    return 0


def calibrate_verification(arguments: argparse.Namespace) -> int:
    """Fit the bounds of verifications; keep everything else."""
    shipped = load_checkpoint(defaults.shipped_model(arguments.fingers))
    recording = arguments.folder / "verification"
    size = ("--objects", VERIFIED, "--grasps", VERIFIED_GRASPS, "--seed", SEED_VERIFIED, "--jobs", arguments.jobs)
    if code := retrieve("collect", "--rig", RIG, *size, "--out", recording):
        return code
    grasps = load_grasps(recording)
    if arguments.fingers == 1:
        grasps = [each_finger(grasp)[0] for grasp in grasps]
    trials, photos = scored_touches(shipped, grasps, arguments.folder / "features")
    assert shipped.posterior is not None
    embeddings = photo_embeddings(shipped.matcher, torch.stack(list(photos.values())))
    verification = fit_verification(trials.scored, embeddings, shipped.posterior)
    made = same_codes(dataclasses.replace(shipped, verification=verification), shipped)
    store(made, arguments.folder / defaults.SHIPPED[arguments.fingers])
    return 0


def scored_touches(made: Checkpoint, grasps: list[Grasp], cache: Path) -> tuple[ReferenceTouches, dict[Path, Tensor]]:
    """Return the touches of grasps, scored with their photos, and the features of each photo."""
    features, device = encode_recording(grasps, made.matcher, made.config, cache), default_device()
    with FrozenFeatures(made.config, device, features_by_image(grasps, features, device)) as source:
        touches, photos = recorded_features(made.matcher, source, grasps, what="calibration", quiet=False)
    trials = posterior_touches(made.matcher, grasps, touches, photos)
    assert trials is not None
    return trials, photos


def collect_of(recording: Path, names: Sequence[str], grasps: int, jobs: int) -> list[Grasp]:
    """Collect these objects of the object set of `make`."""
    robot.collect(
        functools.partial(robot.load_rig, str(RIG), seed=SEED_TRAINED),
        recording,
        objects=names,
        seed=SEED_TRAINED,
        settings=robot.CollectSettings(grasps=grasps),
        jobs=jobs,
    )
    return load_grasps(recording)


def same_codes(made: Checkpoint, before: Checkpoint) -> Checkpoint:
    """Return a checkpoint with the towers and head of the one before: indexes keep their partial activations."""
    partials_from = [*before.provenance.get(PARTIALS_FROM, []), before.digest]
    return dataclasses.replace(made, provenance=made.provenance | {PARTIALS_FROM: partials_from})


def fit_calibration(made: Checkpoint, grasps: list[Grasp], features: Features) -> Checkpoint:
    """Return a checkpoint with its posterior and its gel check."""
    assert made.split is not None
    device = default_device()
    with FrozenFeatures(made.config, device, features_by_image(grasps, features, device)) as source:
        parts = (made.split.select(grasps, part) for part in ("train", "validation"))
        return with_verdicts(made, source, *parts, foreign=FOREIGN)


def distil_shipped(arguments: argparse.Namespace) -> int:
    """Retrain the candidate encoder on the shipped, rounded weights; keep towers, head, calibration and split."""
    shipped = load_checkpoint(defaults.shipped_model(arguments.fingers))
    grasps = load_grasps(arguments.folder / "recording")
    if arguments.fingers == 1:
        grasps = [part for grasp in grasps for part in each_finger(grasp)]
    features = encode_recording(grasps, shipped.matcher, shipped.config, arguments.folder / "features")
    assert shipped.split is not None
    train, validation = (features.of_objects(part) for part in (shipped.split.train, shipped.split.validation))
    paths = {"photos": str(arguments.folder / "photos"), "touches": str(arguments.folder / "touches")}
    training = dataclasses.replace(shipped.config.training, **paths)
    pairs = labelled_pairs(dataclasses.replace(shipped.config, training=training))
    train = train.concatenate(encode_recording(pairs, shipped.matcher, shipped.config, arguments.folder / "features"))
    made = same_codes(distilled(shipped, train, validation, arguments.steps), shipped)
    store(made, arguments.folder / defaults.SHIPPED[arguments.fingers])
    return 0


def distilled(made: Checkpoint, train: Features, validation: Features, steps: int) -> Checkpoint:
    """Return a checkpoint with the preset's candidate encoder."""
    training = dataclasses.replace(made.config.training, distil_steps=steps)
    config = dataclasses.replace(made.config.with_candidate_encoder_of(load_config(PRESET)), training=training)
    with one_thread():  # like training on frozen features
        partials = (distil.feature_partials(made.matcher, part) for part in (train, validation))
        return distil.with_candidate_encoder(made, config, *partials)


def store(made: Checkpoint, out: Path) -> None:
    """Write a checkpoint as float16, without the paths of its first weights on this machine."""
    training = dataclasses.replace(
        made.config.training, init="imagenet", init_photo="", init_touch="", photos="", touches=""
    )
    made = dataclasses.replace(made, config=dataclasses.replace(made.config, training=training))
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
