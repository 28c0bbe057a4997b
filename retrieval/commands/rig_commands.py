"""What the commands around a rig do: collect, rig and import. As in retrieval.commands.cli, results go to stdout."""

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from retrieval.console.files import HAND_EYE, PREVIEW, require_ours
from retrieval.console.output import print_json, say, show
from retrieval.console.progress import CollectBar
from retrieval.errors import RetrievalError

if TYPE_CHECKING:
    from robot.sight.hand_eye import Errors


def run_collect(arguments: argparse.Namespace) -> None:
    """`retrieve collect`."""
    if arguments.dry_run:
        _rehearse(arguments)
        return
    from functools import partial

    from robot.collect import CollectSettings, collect
    from robot.recording.attempt_log import acceptance_table
    from robot.rig import load_rig

    preview = _preview_of(arguments.out)
    if arguments.preview:
        require_ours(preview, PREVIEW)
    gate, gate_name = _load_gate(arguments.gate)
    settings = CollectSettings(grasps=arguments.grasps)
    try:
        with CollectBar() as bar:
            tallies = collect(
                partial(load_rig, arguments.rig, seed=arguments.seed),
                arguments.out,
                objects=arguments.objects,
                seed=arguments.seed,
                settings=settings,
                gate=gate,
                gate_name=gate_name,
                jobs=arguments.jobs,
                progress=bar,
            )
    except KeyboardInterrupt:
        say(f"what was collected is whole in {arguments.out}; the same command goes on with it")
        raise
    for line in acceptance_table(tallies, wanted=settings.grasps).splitlines():
        say(line)
    accepted = sum(each.accepted for each in tallies)
    if accepted == 0:
        raise RetrievalError(f"no grasp was accepted; {arguments.out}/attempts.jsonl says why")
    say(f"{arguments.out}: {accepted} accepted grasps of {len(tallies)} objects")
    if arguments.preview:
        from robot.sim.preview import write_preview

        say(f"preview: {write_preview(arguments.out, preview)}")


def _preview_of(out: Path) -> Path:
    """Beside the recording: every image inside belongs to a grasp."""
    folder = out if out.name not in ("", "..") else out.resolve()
    return folder.with_name(f"{folder.name}-preview.png")


def _rehearse(arguments: argparse.Namespace) -> None:
    """`--dry-run`: the motions of one attempt at each object, on stdout; nothing moves, nothing is recorded."""
    from robot.grasping.attempt import Attempter
    from robot.grasping.dry_run import without_motion
    from robot.rig import load_rig

    rig = without_motion(load_rig(arguments.rig, seed=arguments.seed), show)
    with rig:
        attempter = Attempter(rig, arguments.seed, rig.attempt)
        for object_id in rig.object_ids(arguments.objects):
            attempt = attempter.run(object_id, 0)
            say(f"{object_id}: {attempt.reason or 'nothing was moved, nothing was recorded'}")


def run_rig(arguments: argparse.Namespace) -> None:
    """`retrieve rig`."""
    {"check": _check_rig, "calibrate": _calibrate}[arguments.task](arguments)


def _check_rig(arguments: argparse.Namespace) -> None:
    """What is connected; with a rig, each device exercised gently."""
    from robot.drivers.discover import discover
    from robot.rig import load_rig
    from robot.rig_check import check_rig

    if arguments.rig is None:
        found = discover()
        if arguments.json:
            print_json({"found": [dataclasses.asdict(device) for device in found]})
            return
        for device in found:
            for line in (f"# {device.kind}: {device.label}", *device.toml.splitlines(), ""):
                show(line)
        say(f"{len(found)} device(s) found; the lines above go into a rig's file" if found else "no device was found")
        return
    rows = []
    for row in check_rig(load_rig(arguments.rig, seed=0), motion=not arguments.no_motion):
        rows.append(row)
        if not arguments.json:
            show(row.line())
    if arguments.json:
        print_json({"devices": [dataclasses.asdict(row) for row in rows]})
    if failed := sum(row.failure is not None for row in rows):
        raise RetrievalError(f"{failed} of {len(rows)} checks failed; see above")


def _calibrate(arguments: argparse.Namespace) -> None:
    """Where the camera stands, from points known in its frame and in the rig's."""
    from robot.sight.hand_eye import SUSPECT_MM, fit_hand_eye, read_pairs

    require_ours(arguments.out, HAND_EYE)
    found = fit_hand_eye(*read_pairs(arguments.points))
    for name, errors in (("rigid", found.rigid_errors), ("affine", found.affine_errors)):
        say(f"{name}: {_off_by(errors)}" if errors else f"{name}: {found.no_affine}")
    if found.warning:
        say(f"warning: {found.warning}")
    if found.rigid_errors.loo_mean_mm > SUSPECT_MM:
        raise RetrievalError(f"nothing was written: an arm cannot be steered by points {SUSPECT_MM:g} mm off and more")
    found.save(arguments.out)
    say(f"{arguments.out}: written from {len(found.rig_mm)} points; name it as hand_eye under [camera]")


def _off_by(errors: "Errors") -> str:
    return (
        f"points are {errors.mean_mm:.1f} mm off (at most {errors.max_mm:.1f}); each when left out "
        f"{errors.loo_mean_mm:.1f} mm ({errors.loo_max_mm:.1f})"
    )


def _load_gate(path: Path | None) -> tuple[Any, str | None]:
    """A learned gate, and a name that is another one for other weights; None for the collector's own rule."""
    if path is None:
        return None, None
    from retrieval.model.stored import file_digest
    from retrieval.training.grasp_success import load_gate

    gate = load_gate(path)
    return gate, f"learned, sha256 {file_digest(path)}"


def run_import(arguments: argparse.Namespace) -> None:
    """`retrieve import`."""
    from robot.importers import load_importer

    recording = load_importer(arguments.name)(arguments.source, arguments.out)
    for note in recording.notes:
        say(note)
    objects = len({grasp.object_id for grasp in recording.grasps})
    say(f"{arguments.out}: {len(recording.grasps)} grasps of {objects} objects")
