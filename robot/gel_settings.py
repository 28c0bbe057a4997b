"""Material of the gels on a rig's fingers: read from the rig's file and written into every recording.

[gel.a]
thickness_mm = 3.0
modulus_mpa = 0.35      # Young's modulus; leave out unknown values
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Any

from msgspec import Meta

from robot.errors import RobotConfigError
from robot.settings import TypedSettings, build

UNKNOWN = "unknown"


@dataclass(frozen=True)
class GelSettings(TypedSettings):
    """Thickness, Young's modulus and Poisson's ratio of one gel; None if unknown (then random in simulation)."""

    thickness_mm: Annotated[float, Meta(ge=0.01, le=100.0)] | None = None
    modulus_mpa: Annotated[float, Meta(ge=1e-4, le=1e3)] | None = None
    poisson: Annotated[float, Meta(ge=0.0, le=0.5)] | None = None

    def known(self) -> dict[str, float]:
        """Return the known values by name."""
        return {name: float(value) for name, value in asdict(self).items() if value is not None}

    def to_dict(self) -> dict[str, float | str]:
        """Return all values as recording.json stores them, with "unknown" for each unknown value."""
        return {**dict.fromkeys(asdict(self), UNKNOWN), **self.known()}


def parse_gel_settings(tables: Mapping[str, Any], fingers: Iterable[str]) -> dict[str, GelSettings]:
    """Return the gel of each finger that has a sensor, from the tables [gel.a] and [gel.b] of a rig's file.

    Raise RobotConfigError if a table names another finger, or has an invalid setting.
    """
    gels = {finger: GelSettings() for finger in sorted(fingers)}
    for finger, table in tables.items():
        if finger not in gels or not isinstance(table, Mapping):
            known = ", ".join(f"[gel.{name}]" for name in gels)
            raise RobotConfigError(f"gel tables must name a finger with a sensor: {known}; got {finger!r}")
        gels[finger] = build(GelSettings, table, where=f"[gel.{finger}]")
    return gels
