"""What the gels on a rig's fingers are made of, as far as is known: said in its file, written into every recording.

[gel.a]
thickness_mm = 3.0
modulus_mpa = 0.35      # Young's modulus; leave out what is not known
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from robot.errors import RobotConfigError
from robot.settings import TypedSettings, bounded, build

UNKNOWN = "unknown"


@dataclass(frozen=True)
class GelSettings(TypedSettings):
    """One finger's gel: thickness, Young's modulus, Poisson's ratio; None: not known, and drawn where simulated."""

    thickness_mm: float | None = bounded(0.01, 100.0, None)
    modulus_mpa: float | None = bounded(1e-4, 1e3, None)
    poisson: float | None = bounded(0.0, 0.5, None)

    def known(self) -> dict[str, float]:
        """What was said, by name."""
        return {name: float(value) for name, value in asdict(self).items() if value is not None}

    def to_dict(self) -> dict[str, float | str]:
        """As in recording.json, where what is not known is "unknown"."""
        return {**dict.fromkeys(asdict(self), UNKNOWN), **self.known()}


def parse_gel_settings(tables: Mapping[str, Any], fingers: Iterable[str]) -> dict[str, GelSettings]:
    """The gel of each finger, from the tables [gel.a] and [gel.b] of a rig's file. Raises RobotConfigError."""
    found = {finger: GelSettings() for finger in sorted(fingers)}
    for finger, table in tables.items():
        if finger not in found or not isinstance(table, Mapping):
            known = ", ".join(f"[gel.{each}]" for each in found)
            raise RobotConfigError(f"gels must be said of the fingers that feel, in {known}; got {finger!r}")
        found[finger] = build(GelSettings, table, where=f"[gel.{finger}]")
    return found
