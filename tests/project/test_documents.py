"""Plain documents as typed values, and what is said of those that do not fit."""

import re
from dataclasses import dataclass, field
from typing import Annotated

import pytest
from msgspec import Meta

from _touch_retrieval.documents import typed


@dataclass(frozen=True)
class Gel:
    pitch_mm: float
    markers: Annotated[int, Meta(ge=0)] = 0


@dataclass(frozen=True)
class Sensor:
    gel: Gel
    sides: tuple[float, float] = (1.0, 1.0)
    name: str | None = None
    frozen: bool = False
    lights: dict[str, float] | None = None
    spares: tuple[Gel, ...] = ()
    by_name: dict[str, Gel] = field(default_factory=dict)


def test_tables_become_dataclasses_lists_tuples_and_whole_numbers_floats():
    sensor = typed({"gel": {"pitch_mm": 2, "markers": 4}, "sides": [3, 4.5]}, Sensor)
    assert sensor == Sensor(Gel(2.0, 4), (3.0, 4.5))
    assert type(sensor.gel.pitch_mm) is float


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"gel": {"pitch_mm": "2"}}, "[sensor].gel.pitch_mm must be a number, got '2'"),
        ({"gel": {"pitch_mm": 2, "markers": -1}}, "[sensor].gel.markers must be a whole number >= 0, got -1"),
        ({"gel": {"pitch_mm": True}}, "[sensor].gel.pitch_mm must be a number, got True"),
        ({"gel": {}}, "[sensor].gel: object missing required field `pitch_mm`"),
        ({"gel": [2]}, "[sensor].gel must be a table, got [2]"),
        ({"gel": {"pitch_mm": 2, "lamp": 1}}, "[sensor].gel has no setting 'lamp'; it knows markers, pitch_mm"),
        ({"spares": [{"pitch_mm": 2, "lamp": 1}]}, "[sensor].spares has no setting 'lamp'; it knows markers, pitch_mm"),
        ({"by_name": {"a": {"pitch_mm": 2, "lamp": 1}}}, "[sensor].by_name has no setting 'lamp'; it knows markers"),
        ({"sides": [1]}, "[sensor].sides must be a list of length 2, got [1]"),
        ({"sides": [1, "x"]}, "[sensor].sides[1] must be a number, got 'x'"),
        ({"name": 3}, "[sensor].name must be a text in quotes or nothing, got 3"),
        ({"frozen": 1}, "[sensor].frozen must be true or false, got 1"),
        ({"lights": {"red": "on"}}, "[sensor].lights must be a number, got `str`"),
        ({"lights": {"red": float("nan")}}, "[sensor].lights.red must be a finite number, within 64 bits, got nan"),
        ({"gel": {"pitch_mm": 2**63}}, "[sensor].gel.pitch_mm must be a finite number, within 64 bits, got 92233"),
    ],
)
def test_a_value_that_does_not_fit_is_refused_with_its_place_and_what_it_must_be(changed, said):
    with pytest.raises(ValueError, match="^" + re.escape(said)):
        typed({"gel": {"pitch_mm": 2}} | changed, Sensor, "[sensor]")
