"""Conversion of plain documents to typed values, and errors for invalid ones."""

import re
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest
from msgspec import Meta

from _touch_retrieval.documents import check_fields, typed


@dataclass(frozen=True)
class Gel:
    pitch_mm: float
    markers: Annotated[int, Meta(ge=0)] = 0


@dataclass(frozen=True)
class Sensor:
    gel: Gel
    sides: tuple[float, float] = (1.0, 1.0)
    lights: dict[str, float] | None = None


def test_tables_become_dataclasses_lists_become_tuples_and_integers_become_floats():
    sensor = typed({"gel": {"pitch_mm": 2, "markers": 4}, "sides": [3, 4.5]}, Sensor)
    assert sensor == Sensor(Gel(2.0, 4), (3.0, 4.5))
    assert type(sensor.gel.pitch_mm) is float


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gel": {"pitch_mm": "2"}}, "[sensor].gel.pitch_mm must be a number, got '2'"),
        ({"gel": {"pitch_mm": 2, "markers": -1}}, "[sensor].gel.markers must be a whole number >= 0, got -1"),
        ({"gel": {}}, "[sensor].gel: object missing required field `pitch_mm`"),
        ({"gel": {"pitch_mm": 2, "lamp": 1}}, "[sensor].gel has no setting 'lamp'; known settings: markers, pitch_mm"),
        ({"sides": [1, "x"]}, "[sensor].sides[1] must be a number, got 'x'"),
        ({"lights": {"red": float("nan")}}, "[sensor].lights.red must be a finite number, got nan"),
        ({"gel": {"pitch_mm": 2**63}}, "[sensor].gel.pitch_mm must fit into 64 bits, got 92233"),
    ],
)
def test_an_invalid_value_is_refused_with_its_path_and_its_type(changes, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        typed({"gel": {"pitch_mm": 2}} | changes, Sensor, "[sensor]")


class LampError(Exception):
    pass


@dataclass(frozen=True)
class Lamp:
    watts: Annotated[float, Meta(gt=0)]
    gel: Gel | None = None

    def __post_init__(self):
        check_fields(self, "lamp", LampError)


def test_fields_set_in_python_are_checked_and_converted_like_those_of_a_document():
    lamp = Lamp(np.int64(3), Gel(2.0))
    assert (lamp, type(lamp.watts)) == (Lamp(3.0, Gel(2.0)), float)
    for make in (Lamp, lambda watts: typed({"watts": watts}, Lamp, "lamp", error=LampError)):
        for watts, message in ((-1, r"number > 0\.0, got -1$"), (float("nan"), "finite number, got nan")):
            with pytest.raises(LampError, match=rf"^lamp\.watts must be a {message}"):
                make(watts)


def test_a_table_and_its_inner_tables_can_be_required_to_be_complete():
    gel = {"pitch_mm": 2, "markers": 0}
    assert typed({"watts": 1, "gel": gel}, Lamp, "lamp", complete=True) == Lamp(1.0, Gel(2.0))
    for document, message in (
        ({"watts": 1}, r"^lamp must have watts, gel; gel is missing$"),
        ({"watts": 1, "gel": {"pitch_mm": 2}}, r"^lamp\.gel must have pitch_mm, markers; markers is missing$"),
        ({"watts": 1, "gel": gel | {"x": 1}}, r"^lamp\.gel has no setting 'x'"),
    ):
        with pytest.raises(ValueError, match=message):
            typed(document, Lamp, "lamp", complete=True)
