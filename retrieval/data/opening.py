"""Openings of the jaws on an object, in millimetres between the fingers: which are believed, and their input."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from retrieval.errors import BadInput

Openings: TypeAlias = float | Sequence[float | None] | None
"""The opening of each grasp in millimetres, None where it was not measured; a number for one grasp; None for none."""
RANGE_MM = (0.5, 300.0)
"""Openings that are believed: what grippers hold. Less is metres in most cases, more another unit or an angle."""


def parse_openings(openings: Openings, grasps: int, of: str = "") -> list[float | None]:
    """Return the opening of each grasp in millimetres, None where none was measured.

    Args:
        openings: As `Openings`.
        grasps: Number of grasps.
        of: Prefix of messages, such as "object 3, ".

    Raises:
        BadInput: The number of openings is not that of grasps, or an opening is outside `RANGE_MM`.
    """
    if openings is None:
        return [None] * grasps
    given: list[object] = np.atleast_1d(np.array(openings, dtype=object)).tolist()
    if len(given) != grasps:
        raise BadInput(
            f"{of}give one opening for each grasp, or none: got {len(given)} opening(s) for {grasps} grasp(s); None "
            "stands for a grasp without one"
        )
    return [None if opening is None else require_opening(opening, f"{of}opening_mm") for opening in given]


def require_opening(value: object, name: str) -> float:
    """Return an opening in millimetres. Raises BadInput with its name if it is not a number in `RANGE_MM`."""
    low, high = RANGE_MM
    number = value if isinstance(value, int | float | np.number) and not isinstance(value, bool) else np.nan
    if low <= number <= high:
        return float(number)
    hint = "; the value looks like metres" if 0 < number < low else ""
    raise BadInput(
        f"{name} must be the distance between the fingers in millimetres, from {low:g} to {high:g}; got {value!r:.40}"
        f"{hint}"
    )


def believed(opening_mm: float | None) -> float | None:
    """Return an opening that a gripper measured; None for one outside `RANGE_MM`."""
    low, high = RANGE_MM
    return opening_mm if opening_mm is not None and low <= opening_mm <= high else None
