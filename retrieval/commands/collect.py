"""`retrieve collect`: collect a recording with a rig."""

from pathlib import Path
from typing import Annotated, Any

import typer

from retrieval.commands.options import COUNT, SEED, Jobs, Objects, refuse_options
from retrieval.console.interruption import resumable
from retrieval.console.output import say, show
from retrieval.console.progress import Bar
from retrieval.errors import RetrievalError


def collect(
    *,
    rig: Annotated[str, typer.Option(help="rig by name or TOML file; sim is the simulated rig")] = "sim",
    objects: Objects = 98,
    grasps: Annotated[int, typer.Option(parser=COUNT, help="accepted grasps per object")] = 44,
    out: Annotated[Path, typer.Option(help="recording folder to write or continue")],
    seed: Annotated[int, typer.Option(parser=SEED, help="seed of all random choices")] = 0,
    jobs: Jobs = 1,
    gate: Annotated[
        Path | None, typer.Option(help="grasp-success checkpoint (default: a rule on the contact area)")
    ] = None,
    rounds: Annotated[
        bool,
        typer.Option(
            "--rounds",
            help="one accepted grasp of each object, then the next round, so that drift does not identify the object",
        ),
    ] = False,
    session: Annotated[
        str | None,
        typer.Option(help="name of this sitting, such as a day; a new name adds a session to the recording"),
    ] = None,
    preview: Annotated[bool, typer.Option("--preview", help="write an overview image, OUT-preview.png")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="print the motions of one attempt per object; arm and gripper do not move")
    ] = False,
) -> None:
    """Collect a recording with a rig; stay next to a real rig. Resumes a stopped run."""
    if dry_run:
        ignored = {"gate": gate, "preview": preview, "rounds": rounds, "session": session}
        refuse_options("has no effect with --dry-run, which moves and records nothing; leave it out", **ignored)
        _print_motions(rig, objects, seed)
        return
    from functools import partial

    from robot.collection import CollectSettings
    from robot.collection import collect as collect_grasps
    from robot.recording.attempt_log import acceptance_table
    from robot.rig import load_rig

    decide: Any = None
    gate_name = None
    if gate is not None:
        from _touch_retrieval.files import file_digest
        from retrieval.model.gate import load_gate

        decide, gate_name = load_gate(gate), f"learned, sha256 {file_digest(gate)}"
    with resumable(out), Bar("collecting", 0, "grasps") as bar:
        tallies = collect_grasps(
            partial(load_rig, rig, seed=seed),
            out,
            objects=objects,
            seed=seed,
            settings=CollectSettings(grasps=grasps, rounds=rounds),
            gate=decide,
            gate_name=gate_name,
            jobs=jobs,
            session=session,
            progress=lambda now: bar.show(now.grasps_done, now.grasps_target, str(now)),
        )
    for line in acceptance_table(tallies, grasps_target=grasps).splitlines():
        say(line)
    accepted = sum(tally.accepted for tally in tallies)
    if accepted == 0:
        raise RetrievalError(f"no grasp was accepted; {out}/attempts.jsonl lists the reasons")
    skipped = sum(tally.skipped is not None for tally in tallies)
    say(
        f"{out}: {accepted} accepted grasps of {len(tallies) - skipped} objects"
        + f", {skipped} skipped" * bool(skipped)
        + f", in session {session}" * (session is not None)
    )
    if preview:
        from robot.recording.preview import write_preview

        folder = out.resolve()  # the overview is next to the recording, because every image inside belongs to a grasp
        say(f"preview: {write_preview(out, folder.with_name(f'{folder.name}-preview.png'))}")


def _print_motions(name: str, objects: int, seed: int) -> None:
    from robot.grasping.attempt import AttemptRunner
    from robot.grasping.dry_run import make_dry_run
    from robot.rig import load_rig

    with make_dry_run(load_rig(name, seed=seed), show) as rig:
        runner = AttemptRunner(rig, seed, rig.attempt)
        for object_id in rig.object_ids(objects):
            say(f"{object_id}: {runner.run(object_id, 0).reason or 'nothing moved, nothing was recorded'}")
