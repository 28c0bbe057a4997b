"""Plain settings, as TOML gives them, to the keywords of a class: checked by their names and annotated types."""

import inspect
import math
import typing
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from robot.errors import RobotConfigError

_T = TypeVar("_T")
_MOST = 2**63
_PLAIN: Mapping[Any, tuple[type | tuple[type, ...], str]] = {
    bool: (bool, "true or false"),
    int: (int, "a whole number"),
    float: ((int, float), "a number"),
    str: (str, "a text in quotes"),
}


def build(cls: type[_T], settings: Mapping[str, Any], *, where: str = "", **given: Any) -> _T:
    """An object of `cls` from plain `settings`, and from what the program gives: those that the class takes.

    where: what a message begins with, such as the table of a file. Raises RobotConfigError for an unknown setting, a
    missing one, or one of another type than the class annotates; the class itself checks ranges.
    """
    parameters = inspect.signature(cls).parameters
    known = sorted(set(parameters) - set(given))
    if unknown := sorted(set(settings) - set(known)):
        raise RobotConfigError(f"{where or cls.__name__} has no setting {unknown[0]!r}; it knows {', '.join(known)}")
    required = (name for name in known if parameters[name].default is inspect.Parameter.empty)
    if missing := sorted(set(required) - set(settings)):
        raise RobotConfigError(f"{where or cls.__name__} must say {missing[0]!r}; it knows {', '.join(known)}")
    hints = typing.get_type_hints(cls.__init__)
    for name, value in settings.items():
        check_type(f"{where}: {name}" if where else name, hints.get(name), value)
    return cls(**settings, **{name: value for name, value in given.items() if name in parameters})


def check_type(name: str, hint: Any, value: object) -> None:
    """Raise RobotConfigError for a plain value, table or list of plain values that is not of the annotated type, and
    for numbers that are not finite or beyond 64 bits, which no setting means."""
    _check_finite(name, value)
    kind, inner = typing.get_origin(hint), typing.get_args(hint)
    if kind in (Sequence, tuple):
        good = isinstance(value, list | tuple) and all(_is_plain(each, inner[0]) for each in value)
        words = f"a list, each of them {_PLAIN[inner[0]][1]}" if inner[0] in _PLAIN else "a list"
    elif kind is Mapping:
        good, words = isinstance(value, Mapping), "a table"
    else:
        options = [each for each in inner if each is not type(None)] or [hint]
        if value is None and type(None) in inner:
            return
        good = any(_is_plain(value, option) for option in options)
        words = " or ".join(_PLAIN[option][1] for option in options if option in _PLAIN)
    if not good:
        raise RobotConfigError(f"{name} must be {words}, got {value!r}")


def check_range(name: str, value: float, least: float, most: float, unit: str = "") -> None:
    """Raise RobotConfigError unless a setting is a finite number from `least` to `most`."""
    if not least <= value <= most or math.isinf(value):  # also refuses NaN
        raise RobotConfigError(f"{name} must be from {least:g} to {most:g}{unit and ' '}{unit}, got {value!r}")


def _check_finite(name: str, value: object) -> None:
    for each in value if isinstance(value, list | tuple) else [value]:
        if isinstance(each, int | float) and not abs(each) < _MOST:  # also refuses NaN
            raise RobotConfigError(f"{name} must be a finite number, within 64 bits, got {str(each)[:40]}")


def _is_plain(value: object, hint: Any) -> bool:
    """Python counts true and false among the whole numbers; a file of settings does not."""
    return hint not in _PLAIN or (isinstance(value, _PLAIN[hint][0]) and (hint is bool or not isinstance(value, bool)))
