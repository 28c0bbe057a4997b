"""Objects from plain settings."""

from collections.abc import Mapping, Sequence
from typing import Any

import pytest

from robot.errors import RobotConfigError
from robot.settings import build


class Thing:
    def __init__(
        self,
        *,
        port: str,
        rate: float = 1.0,
        tries: int = 2,
        loud: bool = False,
        box: Sequence[float] = (),
        names: tuple[str, ...] = (),
        exposure: int | None = None,
        table: Mapping[str, Any] = {},
        clock: object = None,
    ):
        self.made = {name: value for name, value in locals().items() if name != "self"}


def test_settings_and_accepted_program_arguments_become_keywords():
    made = build(Thing, {"port": "a", "rate": 3, "box": [1, 2.5], "exposure": 4}, clock="tick", unknown="left out").made
    assert (made["port"], made["rate"]) == ("a", 3)
    assert made["box"] == [1, 2.5]
    assert made["exposure"] == 4
    assert made["clock"] == "tick"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, r"\[thing\] requires 'port'; known settings: box, exposure"),
        (
            {"port": "a", "bort": 1},
            r"\[thing\] has no setting 'bort'; known settings: box, exposure, loud, names, port",
        ),
        ({"port": "a", "clock": 1}, r"\[thing\] has no setting 'clock'"),  # an argument of the program
        ({"port": 3}, r"\[thing\]: port must be a text in quotes, got 3"),
        ({"port": "a", "rate": "fast"}, r"\[thing\]: rate must be a number, got 'fast'"),
        ({"port": "a", "names": ["b", 3]}, r"\[thing\]: names\[1\] must be a text in quotes, got 3"),
        ({"port": "a", "rate": float("nan")}, r"\[thing\]: rate must be a finite number, got nan"),
    ],
)
def test_a_wrong_setting_is_refused_with_its_place_and_the_requirement(settings, message):
    with pytest.raises(RobotConfigError, match=f"^{message}"):
        build(Thing, settings, where="[thing]", clock="tick")
