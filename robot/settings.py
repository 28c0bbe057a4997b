"""Plain settings, as TOML gives them, to the keywords of a class: checked by name, annotated type and range.

Settings of one thing are one frozen dataclass of `TypedSettings`; a number's range stands next to its default.
"""

import functools
import inspect
import math
import typing
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any, TypeVar

from _touch_retrieval.documents import check_fields, typed
from _touch_retrieval.registry import Registry
from robot.errors import RobotConfigError, UnknownName

_T = TypeVar("_T")


def bounded(lowest: float, highest: float, default: Any = MISSING, *, unit: str = "") -> Any:
    """A field of `TypedSettings` that must be from `lowest` to `highest`; without a default it must be said."""
    return field(default=default, metadata={"range": (lowest, highest, unit)})


@dataclass(frozen=True)
class TypedSettings:
    """Base of dataclasses of settings: each value is of its annotated type (a list becomes a tuple), and in range."""

    def __post_init__(self) -> None:
        """Raises RobotConfigError."""
        check_fields(self, "", RobotConfigError)
        for each in fields(self):
            if (value := getattr(self, each.name)) is not None and "range" in each.metadata:
                check_range(each.name, value, *each.metadata["range"])


def build(cls: type[_T], settings: Mapping[str, Any], *, where: str = "", **given: Any) -> _T:
    """An object of `cls` from plain `settings`, and from what the program gives: those that the class takes.

    A class with an attribute `Settings` takes what that dataclass does, too. where: what a message begins with, such as
    the table of a file. Raises RobotConfigError for an unknown setting, a missing one, or one of another type than is
    annotated; the class itself checks ranges.
    """
    accepted = _keywords(cls)  # type: ignore[arg-type]  # a class is hashable
    keywords = {name: each for name, each in accepted.items() if name not in given}
    known = ", ".join(sorted(keywords))
    if unknown := sorted(set(settings) - set(keywords)):
        raise RobotConfigError(f"{where or cls.__name__} has no setting {unknown[0]!r}; it knows {known}")
    required = {name for name, (_, is_required) in keywords.items() if is_required}
    if missing := sorted(required - set(settings)):
        raise RobotConfigError(f"{where or cls.__name__} must say {missing[0]!r}; it knows {known}")
    try:
        checked = {
            name: typed(value, keywords[name][0], name, error=RobotConfigError) for name, value in settings.items()
        }
        return cls(**checked, **{name: value for name, value in given.items() if name in accepted})
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
                    found[name] = hints.get(name, Any), parameter.default is parameter.empty
    return found


def check_range(name: str, value: float, lowest: float, highest: float, unit: str = "") -> None:
    """Raise RobotConfigError unless a setting is a finite number from `lowest` to `highest`."""
    if not lowest <= value <= highest or math.isinf(value):  # also refuses NaN
        raise RobotConfigError(f"{name} must be from {lowest:g} to {highest:g}{unit and ' '}{unit}, got {value!r}")
