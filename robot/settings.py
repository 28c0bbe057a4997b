"""Objects from plain TOML settings: each setting is checked by its name, annotated type and annotated range.

A group of settings is a frozen dataclass derived from `TypedSettings`. `_touch_retrieval.documents` has common ranges.
"""

import functools
import inspect
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from _touch_retrieval.documents import check_fields, typed
from _touch_retrieval.registry import Registry
from robot.errors import RobotConfigError, UnknownName

_T = TypeVar("_T")


@dataclass(frozen=True)
class TypedSettings:
    """Base of settings dataclasses: checks each value's annotated type (a list becomes a tuple) and range."""

    def __post_init__(self) -> None:
        """Raise RobotConfigError for a value of another type or out of range."""
        check_fields(self, "", RobotConfigError)


def build(cls: type[_T], settings: Mapping[str, Any], *, where: str = "", **arguments: Any) -> _T:
    """Return an object of `cls` from plain `settings` and the program's own arguments.

    Args:
        cls: The class. If it has an attribute `Settings`, the fields of that dataclass are arguments too.
        settings: Plain values by keyword.
        where: Prefix of messages, such as the table of a file.
        arguments: Values from the program; those that the class does not accept are dropped.

    Raises:
        RobotConfigError: A setting is unknown, missing, of another type than annotated, or out of the class's range.
    """
    accepted = _keywords(cls)  # type: ignore[arg-type]  # a class is hashable
    keywords = {name: keyword for name, keyword in accepted.items() if name not in arguments}
    known = ", ".join(sorted(keywords))
    if unknown := sorted(set(settings) - set(keywords)):
        raise RobotConfigError(f"{where or cls.__name__} has no setting {unknown[0]!r}; known settings: {known}")
    if missing := sorted({name for name, (_, is_required) in keywords.items() if is_required} - set(settings)):
        raise RobotConfigError(f"{where or cls.__name__} requires {missing[0]!r}; known settings: {known}")
    try:
        checked = {
            name: typed(value, keywords[name][0], name, error=RobotConfigError) for name, value in settings.items()
        }
        return cls(**checked, **{name: value for name, value in arguments.items() if name in accepted})
    except RobotConfigError as error:
        raise RobotConfigError(f"{where}: {error}" if where else str(error)) from error


def build_named(
    registry: Registry[type[_T]],
    table: Mapping[str, Any],
    key: str,
    *,
    where: str,
    default: str | None = None,
    **arguments: Any,
) -> _T:
    """Return an object of the class that a table names by `key`, built from its other keys (`build`).

    Without `default`, the key is required.

    Raises:
        UnknownName: The registry lacks this name; the message lists the known ones.
        RobotConfigError: A setting is invalid.
    """
    settings = dict(table)
    name = settings.pop(key, default)
    if not isinstance(name, str):
        raise UnknownName(f"{where}: {key} must be one of {', '.join(registry.names())}; got {name!r}")
    return build(registry.resolve(name), settings, where=where, **arguments)


@functools.cache
def _keywords(cls: type) -> dict[str, tuple[Any, bool]]:
    """Return the keyword arguments of a class, each with its annotated type and whether it is required."""
    keywords: dict[str, tuple[Any, bool]] = {}
    for source in filter(None, (getattr(cls, "Settings", None), cls)):
        hints = typing.get_type_hints(source.__init__, include_extras=True)
        for name, parameter in inspect.signature(source).parameters.items():
            if parameter.kind is not parameter.VAR_KEYWORD:
                keywords[name] = hints.get(name, Any), parameter.default is parameter.empty
    return keywords
