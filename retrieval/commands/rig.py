"""`retrieve rig`: check the devices of a rig, and calibrate its camera."""

from pathlib import Path
from typing import Annotated

import typer

from retrieval.commands.options import Command
from retrieval.console.files import require_output
from retrieval.console.output import say, show
from retrieval.errors import RetrievalError

HELP = "Check the devices of a rig, and calibrate its camera."

app = typer.Typer(name="rig", help=HELP, short_help=HELP, subcommand_metavar="TASK [ARGS]...")


@app.command(cls=Command)
def check(
    *,
    rig: Annotated[str | None, typer.Option(help="rig by name or TOML file (default: list connected cameras)")] = None,
    no_motion: Annotated[bool, typer.Option("--no-motion", help="do not move the arm or the jaws")] = False,
) -> None:
    """List connected cameras, or test each device of a rig with small motions."""
    from robot.drivers.discover import find_cameras
    from robot.rig import load_rig
    from robot.rig_check import check_rig

    if rig is None:
        cameras = find_cameras()
        for camera in cameras:
            for line in (f"# {camera.label}", *camera.toml.splitlines(), ""):
                show(line)
        found = f"{len(cameras)} camera(s) found; copy the lines above into a rig file"
        say(found if cameras else "no camera was found")
        return
    rows = []
    for row in check_rig(load_rig(rig, seed=0), motion=not no_motion):
        rows.append(row)
        show(row.line())
    if failed := sum(row.failure is not None for row in rows):
        raise RetrievalError(f"{failed} of {len(rows)} checks failed; see above")


@app.command(cls=Command)
def calibrate(
    points: Annotated[
        Path,
        typer.Argument(
            help="CSV file with columns camera_x_mm, camera_y_mm, camera_z_mm, rig_x_mm, rig_y_mm, rig_z_mm"
        ),
    ],
    *,
    out: Annotated[Path, typer.Option(help="file to write")] = Path("hand_eye.json"),
) -> None:
    """Compute the camera's pose from points that are known in its frame and in the rig's frame."""
    from robot.sight.hand_eye import SUSPECT_MM, fit_hand_eye, read_pairs

    require_output(out, ".json")
    calibration = fit_hand_eye(*read_pairs(points))
    mean_mm = float(calibration.residuals_mm.mean())
    say(f"residuals: mean {mean_mm:.1f} mm, maximum {calibration.residuals_mm.max():.1f} mm")
    if mean_mm > SUSPECT_MM:
        raise RetrievalError(
            f"nothing was written: the mean residual must be at most {SUSPECT_MM:g} mm; check that each camera point "
            "has its rig point and that no axis is mirrored (x right, y down, z forward), then measure the points again"
        )
    calibration.save(out)
    say(f"{out}: fitted to {len(calibration.residuals_mm)} points; set hand_eye to this file under [camera]")
