"""Plain settings, as TOML gives them, to the keywords of a class: checked by name, annotated type and range.

Settings of one thing stand once, as a frozen dataclass of `TypedSettings`; a number's range stands beside its default.
"""

import inspect
import math
import typing
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
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


def limited(least: float, most: float, default: Any = MISSING, *, unit: str = "") -> Any:
    """A field of `TypedSettings` that must be from `least` to `most`; without a default it must be said."""
    return field(default=default, metadata={"range": (least, most, unit)})


@dataclass(frozen=True)
class TypedSettings:
    """Base of dataclasses of settings: each is of its annotated type, a list becomes a tuple, numbers are in range."""

    def __post_init__(self) -> None:
        """Raises RobotConfigError."""
        hints = typing.get_type_hints(type(self))
        for each in fields(self):
            value = getattr(self, each.name)
            check_type(each.name, hints[each.name], value)
            if isinstance(value, list):
                object.__setattr__(self, each.name, tuple(value))
            if value is not None and "range" in each.metadata:
                check_range(each.name, value, *each.metadata["range"])


def build(cls: type[_T], settings: Mapping[str, Any], *, where: str = "", **given: Any) -> _T:
    """An object of `cls` from plain `settings`, and from what the program gives: those that the class takes.

    A class with an attribute `Settings` takes what that dataclass does, too. where: what a message begins with, such as
    the table of a file. Raises RobotConfigError for an unknown setting, a missing one, or one of another type than is
    annotated; the class itself checks ranges.
    """
    keywords = {name: each for name, each in _keywords(cls).items() if name not in given}
    known = ", ".join(sorted(keywords))
    if unknown := sorted(set(settings) - set(keywords)):
        raise RobotConfigError(f"{where or cls.__name__} has no setting {unknown[0]!r}; it knows {known}")
    required = {name for name, (_, is_required) in keywords.items() if is_required}
    if missing := sorted(required - set(settings)):
        raise RobotConfigError(f"{where or cls.__name__} must say {missing[0]!r}; it knows {known}")
    try:
        for name, value in settings.items():
            check_type(name, keywords[name][0], value)
        return cls(**settings, **{name: value for name, value in given.items() if name in _keywords(cls)})
    except RobotConfigError as error:
        raise RobotConfigError(f"{where}: {error}" if where else str(error)) from error


def _keywords(cls: type) -> dict[str, tuple[Any, bool]]:
    """The keywords that a class takes: annotated type, and whether it must be said."""
    found: dict[str, tuple[Any, bool]] = {}
    settings: type | None = getattr(cls, "Settings", None)
    for each in (settings, cls):
        if each is not None:
            hints = typing.get_type_hints(each.__init__)  # type: ignore[misc]
            for name, parameter in inspect.signature(each).parameters.items():
                if parameter.kind is not parameter.VAR_KEYWORD:
                    found[name] = hints.get(name), parameter.default is parameter.empty
    return found


def check_type(name: str, hint: Any, value: object) -> None:
    """Raise RobotConfigError for a plain value, table or list of plain values that is not of the annotated type, and
    for numbers that are not finite or beyond 64 bits, which no setting means."""
    for each in value if isinstance(value, list | tuple) else [value]:
        if isinstance(each, int | float) and not abs(each) < _MOST:  # also refuses NaN
            raise RobotConfigError(f"{name} must be a finite number, within 64 bits, got {str(each)[:40]}")
    kind, inner = typing.get_origin(hint), typing.get_args(hint)
    if kind in (Sequence, tuple):
        count = len(inner) if kind is tuple and inner[-1] is not ... else None
        good = isinstance(value, list | tuple) and all(_is_plain(each, inner[0]) for each in value)
        good = good and count in (None, len(typing.cast(Sequence[Any], value)))
        words = f"a list{f' of {count}' if count else ''}, each of them {_PLAIN[inner[0]][1]}"
    elif kind is Mapping:
        good, words = isinstance(value, Mapping), "a table"
    elif value is None and type(None) in inner:
        return
    else:
        options = [each for each in inner if each is not type(None)] or [hint]
        good = any(_is_plain(value, option) for option in options)
        words = " or ".join(_PLAIN[option][1] for option in options if option in _PLAIN)
    if not good:
        raise RobotConfigError(f"{name} must be {words}, got {value!r}")


def check_range(name: str, value: float, least: float, most: float, unit: str = "") -> None:
    """Raise RobotConfigError unless a setting is a finite number from `least` to `most`."""
    if not least <= value <= most or math.isinf(value):  # also refuses NaN
        raise RobotConfigError(f"{name} must be from {least:g} to {most:g}{unit and ' '}{unit}, got {value!r}")


def _is_plain(value: object, hint: Any) -> bool:
    """Python counts true and false among the whole numbers; a file of settings does not."""
    return hint not in _PLAIN or (isinstance(value, _PLAIN[hint][0]) and (hint is bool or not isinstance(value, bool)))
