"""Approximations of the simulated rig, which is handed over: this package knows no robot."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

from retrieval.lab.frontier.points import Panel, Point, Row, smallest
from retrieval.lab.frontier.sample import Sample, SimulationPoint

CAMERA_NOISE = 0.8
"""Grey levels of a sensor's read noise: what the model can see lies above."""
QUICK_CONTACT: dict[str, Any] = {"rows": (30, 120), "tolerances": (1e-1, 1e-2), "reference_rows": 240}
QUICK_CLOSING: dict[str, Any] = {"steps_s": (2e-3, 1e-3)}


def contact(sample: Sample) -> Row:
    """Grid and tolerance of the gel's contact."""
    points = sample.simulation["contact"](**(QUICK_CONTACT if sample.scale.quick else {}))
    tolerances = {"half-space": 0.1, "layer": 0.1, "gel image": CAMERA_NOISE}
    return Row(
        "Contact of the gel: grid and tolerance",
        "A ball pressed into the gel: on a half-space against Hertz's closed form, on a layer, which the simulated "
        "fingers have, against a fine grid. Then what the camera sees of a ball with ridges 1.5 mm apart, the finest "
        "that objects are drawn with: this decides the grid, since an error below the camera's noise is not seen. Each "
        "colour is a grid, each point a tolerance of the solver.",
        _panels(points, tolerances, "one contact"),
    )


def closing(sample: Sample) -> Row:
    """Time step of the closing jaws."""
    points = sample.simulation["closing"](**(QUICK_CLOSING if sample.scale.quick else {}))
    return Row(
        "Closing jaws: time step",
        "Force of two jaws that close on a spring, implicit steps of order 2, against the closed form. The simulated "
        "rig presses with a given force and needs no motion; the step is the caller's.",
        _panels(points, {"": 1.0}, "50 ms of motion"),
    )


def gel_optics(sample: Sample) -> Row:
    """Degree of the fitted gel optics, against real presses."""
    title = "Gel optics: degree of the fitted model"
    text = (
        "Pictures of real balls pressed into a real gel that were left out of the fit, and what the model says of them."
    )
    return Row(title, text, _panels(sample.simulation["gel_optics"](), {"": 3.5}, "one picture of 240 x 320 pixels"))


def _panels(points: Sequence[SimulationPoint], tolerances: Mapping[str, float], time: str) -> tuple[Panel, ...]:
    """A panel for each approximation; tolerances: words in its name -> what error is accepted."""
    kinds: dict[str, list[SimulationPoint]] = defaultdict(list)
    for point in points:
        kinds[point.approximation].append(point)
    return tuple(_panel(name, found, tolerances, time) for name, found in kinds.items())


def _panel(name: str, found: list[SimulationPoint], tolerances: Mapping[str, float], time: str) -> Panel:
    points = tuple(_point(point) for point in found)
    tolerance = next(value for words, value in tolerances.items() if words in name)
    return Panel(name, time, found[0].unit, found[0].reference, tolerance, points, smallest(points))


def _point(point: SimulationPoint) -> Point:
    """What stands before the first comma of a setting names the series, as does a periodic surface."""
    series, _, setting = point.setting.partition(", ") if "," in point.setting else ("", "", point.setting)
    if setting.endswith(", periodic"):
        series, setting = f"{series} periodic", setting.removesuffix(", periodic")
    setting = setting.removesuffix(", padded")
    return Point(series, setting, abs(point.error), is_default=point.is_default, seconds=point.seconds)
