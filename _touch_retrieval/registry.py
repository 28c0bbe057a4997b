"""Registries of classes and functions by name: built-in ones, entry points, and `module:Class` of any module."""

import hashlib
import inspect
import sys
from collections.abc import Mapping
from importlib import import_module
from operator import attrgetter
from typing import Any, Generic, TypeVar, cast

T = TypeVar("T")


class Registry(dict[str, str], Generic[T]):
    """Named classes or functions of one kind, imported on first use.

    A package adds a name with an entry point of the group `touch_retrieval.<kind>`:

        [project.entry-points."touch_retrieval.methods"]
        my_method = "my_package.my_module:MyMethod"

    `module:Class` is also a name and needs no entry point. The dictionary contains the built-in names; `names()`
    returns all names.

    Names in files (checkpoints, indexes) are untrusted, so `load` imports no module for `module:Class`: the module
    must already be imported. `name_of` trusts the user's name and imports its module.
    """

    def __init__(
        self, noun: str, kind: str, table: Mapping[str, str], *, error: type[Exception], base: str | None = None
    ) -> None:
        """Make a registry.

        Args:
            noun: Name of one entry in error messages, such as "tower".
            kind: Last part of the group of entry points, such as "towers".
            table: Built-in name to "module:Class".
            error: Exception type for an unknown or unusable name.
            base: "module:Class"; each entry is a subclass or an instance of it. None for entries that are functions.
        """
        super().__init__(table)
        self.noun, self.group = noun, f"touch_retrieval.{kind}"
        self._error, self._base = error, base

    def __repr__(self) -> str:
        return f"<registry of {self.group.rpartition('.')[2]}>"

    def names(self) -> list[str]:
        """Return the built-in names, then the names that installed packages add."""
        return list(dict.fromkeys([*self, *sorted(self._installed())]))

    def load(self, name: str, *, imports: bool = False) -> T:
        """Return the entry with this name; `imports`: a user gave it, so the module of `module:Class` is imported.

        Raises the registry's error if it is unknown or unusable.
        """
        if name in self:
            return cast(T, _imported(self[name]))
        place = self._installed().get(name)
        if place is None:
            place, (module, _, attribute) = name, name.partition(":")
            if not module or not attribute:
                known = ", ".join(self.names()) or "(none installed)"
                raise self._error(
                    f"{self.noun} must be one of {known}; got {name!r}. Give module:Class for your own, or install a "
                    f"package that adds one by an entry point of the group {self.group}"
                )
            if not imports and module not in sys.modules:
                raise self._error(
                    f"{self.noun} {name!r}: its module is not imported, and a name in a file cannot import it. Import "
                    f"{module} first, or install a package that adds it by an entry point of the group {self.group}"
                )
        try:
            return self._checked(name, _imported(place))
        except (ImportError, AttributeError) as error:
            raise self._error(
                f"{self.noun} {name!r} cannot be imported: {error}; install its package, or add its folder to "
                "PYTHONPATH"
            ) from error

    def name_of(self, choice: "str | T") -> str:
        """Return the name of a user's choice: a name, a `module:Class`, which is imported, or the object itself.

        Raises the registry's error if it is unknown or unusable.
        """
        if not isinstance(choice, str):
            place = f"{getattr(choice, '__module__', None)}:{getattr(choice, '__qualname__', None)}"
            self._checked(place, choice)
            for name, known in {**self._installed(), **self}.items():
                if known == place:
                    return name
            choice = place
        if choice not in self:
            self.load(choice, imports=True)
        return choice

    def resolve(self, choice: "str | T") -> T:
        """Return the entry for a user's choice; raises as `name_of`."""
        return self.load(self.name_of(choice))

    def _installed(self) -> dict[str, str]:
        """Names that installed packages add, with their "module:Class"."""
        from importlib.metadata import entry_points  # slow to import, and most runs do not need it

        return {point.name: point.value for point in entry_points(group=self.group)}

    def _checked(self, name: str, thing: Any) -> T:
        if self._base is None:
            fits, required = callable(thing), "a function"
        else:
            base = _imported(self._base)
            fits = isinstance(thing, base) or (isinstance(thing, type) and issubclass(thing, base))
            required = f"a {base.__name__}"
        if not fits:
            raise self._error(f"{self.noun} {name!r} must be {required}; got {thing!r}")
        return cast(T, thing)


def _imported(place: str) -> Any:
    module, _, attribute = place.partition(":")
    return attrgetter(attribute)(import_module(module))


def code_digest(*classes: type) -> dict[str, str]:
    """Return {"code": SHA-256} of the source of classes outside this project, or {} without any.

    So an edited loss or method is fitted again. The source is that of the module, or of the class for a notebook.
    """
    sources = []
    for kind in classes:
        if not kind.__module__.startswith("retrieval."):
            module = sys.modules[kind.__module__]
            try:
                sources.append(inspect.getsource(module if getattr(module, "__file__", None) else kind))
            except (OSError, TypeError):  # typed into an interpreter, without source
                sources.append(kind.__qualname__)
    return {"code": hashlib.sha256("\n".join(sources).encode()).hexdigest()} if sources else {}
