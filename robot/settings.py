"""Plain settings, as TOML gives them, to the keywords of a class: checked by name, annotated type and range.

Settings of one thing stand once, as a frozen dataclass of `TypedSettings`; a number's range stands beside its default.
"""

import functools
import inspect
import math
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, TypeVar

from _touch_retrieval.registry import Registry
from robot.errors import RobotConfigError, UnknownName

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
                object.__setattr__(self, each.name, _as_tuple(value))
            if value is not None and "range" in each.metadata:
                check_range(each.name, value, *each.metadata["range"])


def _as_tuple(values: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(_as_tuple(each) if isinstance(each, list) else each for each in values)


def build(cls: type[_T], settings: Mapping[str, Any], *, where: str = "", **given: Any) -> _T:
    """An object of `cls` from plain `settings`, and from what the program gives: those that the class takes.

    A class with an attribute `Settings` takes what that dataclass does, too. where: what a message begins with, such as
    the table of a file. Raises RobotConfigError for an unknown setting, a missing one, or one of another type than is
    annotated; the class itself checks ranges.
    """
    taken = _keywords(cls)  # type: ignore[arg-type]  # a class is hashable
    keywords = {name: each for name, each in taken.items() if name not in given}
    known = ", ".join(sorted(keywords))
    if unknown := sorted(set(settings) - set(keywords)):
        raise RobotConfigError(f"{where or cls.__name__} has no setting {unknown[0]!r}; it knows {known}")
    required = {name for name, (_, is_required) in keywords.items() if is_required}
    if missing := sorted(required - set(settings)):
        raise RobotConfigError(f"{where or cls.__name__} must say {missing[0]!r}; it knows {known}")
    try:
        for name, value in settings.items():
            check_type(name, keywords[name][0], value)
        return cls(**settings, **{name: value for name, value in given.items() if name in taken})
    except RobotConfigError as error:
        raise RobotConfigError(f"{where}: {error}" if where else str(error)) from error


def build_named(
    registry: Registry[type[_T]],
    table: Mapping[str, Any],
    key: str,
    *,
    where: str,
    default: str | None = None,
    **given: Any,
) -> _T:
    """Return an object of the class that `key` of a table names in a registry, built from the table's other keys.

    Args:
        registry: Classes by name.
        table: A table of a rig's file.
        key: The key that holds the name.
        where: What messages call the table.
        default: The name where the table has none; None: it must have one.
        given: As `build` takes it.

    Raises:
        UnknownName: Nothing has this name; lists the known ones.
        RobotConfigError: As `build`.
    """
    settings = dict(table)
    name = settings.pop(key, default)
    if not isinstance(name, str):
        raise UnknownName(f"{where}: {key} must be one of {', '.join(registry.names())}; got {name!r}")
    return build(registry.resolve(name), settings, where=where, **given)


@functools.cache
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
    """Raise RobotConfigError for a plain value, table or list that is not of the annotated type, and for numbers that
    are not finite or beyond 64 bits, which no setting means."""
    for number in _numbers(value):
        if not abs(number) < _MOST:  # also refuses NaN
            raise RobotConfigError(f"{name} must be a finite number, within 64 bits, got {str(number)[:40]}")
    if not _is_of(hint, value):
        raise RobotConfigError(f"{name} must be {_words(hint)}, got {value!r}")


def _numbers(value: object) -> Iterator[float]:
    if isinstance(value, int | float):
        yield value
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _numbers(each)


def _is_of(hint: Any, value: object) -> bool:
    """Python counts true and false among the whole numbers; a file of settings does not."""
    kind, inner = typing.get_origin(hint), typing.get_args(hint)
    if kind in (Sequence, tuple):
        right_length = isinstance(value, list | tuple) and len(value) == (_length(hint) or len(value))
        return right_length and all(_is_of(inner[0], each) for each in typing.cast(Sequence[Any], value))
    if kind is Mapping:
        return isinstance(value, Mapping)
    if inner:  # one of several types, or None
        return any(value is None if option is type(None) else _is_of(option, value) for option in inner)
    return hint not in _PLAIN or (isinstance(value, _PLAIN[hint][0]) and (hint is bool or not isinstance(value, bool)))


def _words(hint: Any) -> str:
    kind, inner = typing.get_origin(hint), typing.get_args(hint)
    if kind in (Sequence, tuple):
        return f"a list{f' of {_length(hint)}' if _length(hint) else ''}, each of them {_words(inner[0])}"
    if kind is Mapping:
        return "a table"
    return " or ".join(_PLAIN[option][1] for option in inner or (hint,) if option in _PLAIN)


def _length(hint: Any) -> int | None:
    """Of tuple[float, float] 2, of tuple[float, ...] or a sequence none."""
    inner = typing.get_args(hint)
    return len(inner) if typing.get_origin(hint) is tuple and inner[-1] is not ... else None


def check_range(name: str, value: float, least: float, most: float, unit: str = "") -> None:
    """Raise RobotConfigError unless a setting is a finite number from `least` to `most`."""
    if not least <= value <= most or math.isinf(value):  # also refuses NaN
        raise RobotConfigError(f"{name} must be from {least:g} to {most:g}{unit and ' '}{unit}, got {value!r}")
