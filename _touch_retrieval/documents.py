"""The checker of all settings and documents: types and ranges stand in annotations, and msgspec checks them.

    @dataclass(frozen=True)
    class LampSettings:
        watts: Positive
        channels: Annotated[int, Meta(ge=1, le=4)] = 3

        def __post_init__(self) -> None:
            check_fields(self, "lamp", ConfigError)

`typed` converts a document (JSON, TOML, the value of an option); `check_fields` checks an object that code constructs.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

T = TypeVar("T")

Count = Annotated[int, Meta(ge=1)]
Seed = Annotated[int, Meta(ge=0, lt=2**32)]
Positive = Annotated[float, Meta(gt=0)]
NonNegative = Annotated[float, Meta(ge=0)]
Fraction = Annotated[float, Meta(ge=0, le=1)]

_WORDS = {
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "str": "a text in quotes",
    "array": "a list",
    "object": "a table",
    "null": "nothing",
}
_STEP = re.compile(r"\.(\w+)|\[(\d+)\]")


def typed(
    document: Any, kind: type[T], name: str = "", *, complete: bool = False, error: type[Exception] = ValueError
) -> T:
    """Convert a plain document to a value of a type.

    Lists become tuples and whole numbers become floats if the type requires it; a numpy scalar becomes a number.
    Nothing else is converted. Keys that the dataclass does not have, numbers that are not finite and whole numbers
    beyond 64 bits are errors.

    Args:
        document: The result of `json.loads` or `tomllib.loads`, or a part of it.
        kind: Any type that msgspec checks, often a dataclass. `Annotated[int, msgspec.Meta(ge=1)]` states a range.
        name: Name of the document in messages, such as the table of a file.
        complete: Require a key for each field of the dataclass; otherwise missing fields get their defaults.
        error: Exception type to raise instead of ValueError.

    Raises:
        ValueError: A value does not fit. The message contains its name, its required type and its value.

    >>> typed({"low": 1, "high": 2}, dict[str, float])
    {'low': 1.0, 'high': 2.0}
    """
    document = document.item() if hasattr(document, "item") else document
    try:
        _require_known(document, kind, name, complete)
        _require_finite(document, name)
        return msgspec.convert(document, kind)
    except msgspec.ValidationError as invalid:
        raise error(_error_message(str(invalid), document, kind, name)) from invalid
    except ValueError as invalid:
        raise error(str(invalid)) from invalid


def check_fields(instance: Any, name: str, error: type[Exception] = ValueError) -> None:
    """Check the fields of a frozen dataclass in its `__post_init__` by the rules of `typed`, and replace them.

    Args:
        instance: The dataclass.
        name: Name of the instance in messages; empty: messages contain only the field's name.
        error: Exception type to raise if a value does not fit.
    """
    for field, hint in _hints(instance.__class__).items():
        value = typed(getattr(instance, field), hint, f"{name}.{field}" if name else field, error=error)
        object.__setattr__(instance, field, value)


@cache
def _hints(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind) if field.init}


def _require_known(document: Any, kind: Any, name: str, complete: bool) -> None:
    if not isinstance(document, Mapping | list | tuple):
        return  # it has no keys
    kind = getattr(kind, "__origin__", kind) if hasattr(kind, "__metadata__") else kind  # of Annotated
    parts: Any = [document]
    kinds = get_args(kind)
    if kinds and get_origin(kind) not in (Union, UnionType):  # a list or a table of these types
        parts = document.values() if isinstance(document, Mapping) else document
    for part in parts:
        for inner_kind in kinds:
            _require_known(part, inner_kind, name, complete)
    if not (isinstance(kind, type) and is_dataclass(kind) and isinstance(document, Mapping)):
        return
    known = _hints(kind)
    if complete and (lacking := [key for key in known if key not in document]):
        raise ValueError(f"{name or 'it'} must have {', '.join(known)}; {lacking[0]} is missing")
    for key, value in document.items():
        if key not in known:
            raise ValueError(f"{name or 'it'} has no setting {key!r}; known settings: {', '.join(sorted(known))}")
        _require_known(value, known[key], f"{name}.{key}" if name else key, complete)


def _require_finite(document: Any, name: str) -> None:
    if isinstance(document, float):
        if not math.isfinite(document):
            raise ValueError(f"{name or 'it'} must be a finite number, got {document}")
    elif isinstance(document, int):
        if not abs(document) < 2**63:
            raise ValueError(f"{name or 'it'} must fit into 64 bits, got {str(document)[:40]}")
    elif isinstance(document, Mapping):
        for key, value in document.items():
            _require_finite(value, f"{name}.{key}" if name else str(key))
    elif isinstance(document, list | tuple):
        for value in document:
            _require_finite(value, name)


def _error_message(message: str, document: Any, kind: Any, name: str) -> str:
    """Return msgspec's message in plain words: `name.key must be a number > 0, got -1`."""
    reason, _, place = message.rstrip("`").partition(" - at `$")
    where = f"{name}{place.replace('[...]', '')}".lstrip(".") or "it"
    required, _, got = reason.removeprefix("Expected ").partition(", got ")
    if reason.startswith("Invalid enum value"):
        required = _choices(kind, place)
    elif required == reason:  # such as a missing field
        return f"{where}: {reason[0].lower()}{reason[1:]}"
    if "[...]" not in place:  # else a value of a table, without its key
        for key, number in _STEP.findall(place):
            document = document[key] if key else document[int(number)]
        got = repr(document)[:80]
    words = re.sub(
        "`([^`]*)`", lambda kinds: " or ".join(_WORDS.get(word, word) for word in kinds[1].split(" | ")), required
    )
    return f"{where} must be {words}, got {got or 'another'}"


def _choices(kind: Any, place: str) -> str:
    """Return what the `Literal` at a place of a type, or a union with one, accepts."""
    for key, _ in _STEP.findall(place):
        kind = _hints(kind)[key] if is_dataclass(kind) and isinstance(kind, type) else str
    kinds = (kind,) if get_origin(kind) is Literal else get_args(kind)
    values = [repr(value) for part in kinds if get_origin(part) is Literal for value in get_args(part)]
    return f"one of {', '.join(values)}" + " or a number" * any(get_origin(part) is Annotated for part in kinds)
