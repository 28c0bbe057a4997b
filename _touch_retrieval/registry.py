"""Things by name: those of this project, of installed packages, and of any module that a user names."""

import sys
from collections.abc import Collection, Iterator, Mapping
from importlib import import_module
from operator import attrgetter
from typing import Any, Generic, TypeVar, cast

T = TypeVar("T")


class Registry(Collection[str], Generic[T]):
    """Names of one kind of thing, each imported when it is used.

    A package adds a name by an entry point of the group `touch_retrieval.<kind>`:

        [project.entry-points."touch_retrieval.methods"]
        my_method = "my_package.my_module:MyMethod"

    `module:Class` is a name, too, and needs no entry point. As a collection it holds the built-in names; `names()`
    gives all.

    A name that stands in a file (a checkpoint, an index) may come from anybody, so `load` imports no module because a
    file names it: `module:Class` must be imported already. `name_of` takes the word of a user, and imports it.
    """

    def __init__(
        self, noun: str, kind: str, table: Mapping[str, str], *, error: type[Exception], base: str | None = None
    ) -> None:
        """Make a registry.

        Args:
            noun: What one of these things is called in an error, such as "tower".
            kind: What ends the name of its group of entry points, such as "towers".
            table: Built-in name to "module:Class".
            error: What is raised for an unknown or unusable name.
            base: "module:Class" that each thing is a subclass or an instance of; None: each is a function.
        """
        self.noun, self.group, self.table = noun, f"touch_retrieval.{kind}", table
        self._error, self._base = error, base

    def __iter__(self) -> Iterator[str]:
        return iter(self.table)

    def __len__(self) -> int:
        return len(self.table)

    def __contains__(self, name: object) -> bool:
        return name in self.table

    def names(self) -> list[str]:
        """Return the built-in names, then those of installed packages."""
        return list(dict.fromkeys([*self.table, *sorted(self._installed())]))

    def load(self, name: str) -> T:
        """Return the thing called `name`. Raises the registry's error where there is none, or where it is unusable."""
        if name in self.table:
            return cast(T, _attribute(import_module(self.table[name].partition(":")[0]), self.table[name]))
        installed = self._installed()
        place = installed.get(name, name)
        module, _, attribute = place.partition(":")
        if not module or not attribute:
            known = ", ".join(self.names())
            raise self._error(
                f"{self.noun} must be one of {known}; got {name!r}. Give module:Class for your own, or install a "
                f"package that adds one by an entry point of the group {self.group}"
            )
        if name not in installed and module not in sys.modules:
            raise self._error(
                f"{self.noun} {name!r} is of a module that is not imported, and a file may not choose what is: import "
                f"{module} first, or install a package that names it by an entry point of the group {self.group}"
            )
        try:
            return self._checked(name, _attribute(import_module(module), place))
        except (ImportError, AttributeError) as error:
            raise self._error(f"{self.noun} {name!r} cannot be imported: {error}") from error

    def name_of(self, choice: "str | T") -> str:
        """Return the name of what a user gives: a name, a `module:Class`, which is imported, or the thing itself.

        Raises the registry's error for an unknown name, and for a thing that no name leads to.
        """
        if isinstance(choice, str):
            if choice in self.table:
                return choice
            module, _, attribute = choice.partition(":")
            if attribute and choice not in self.names():
                try:
                    import_module(module)
                except ImportError as error:
                    raise self._error(
                        f"{self.noun} {choice!r} cannot be imported ({error}); install its package, or put its folder "
                        "on PYTHONPATH"
                    ) from error
            self.load(choice)
            return choice
        place = f"{getattr(choice, '__module__', None)}:{getattr(choice, '__qualname__', None)}"
        names = [name for name, its in {**self._installed(), **self.table}.items() if its == place]
        self._checked(place, choice)
        if not names and _attribute_or_none(place) is not choice:
            raise self._error(f"{self.noun} {place!r} must stand at the top level of its module, to be found again")
        return names[0] if names else place

    def resolve(self, choice: "str | T") -> T:
        """Return the thing that a user names or gives; raises what `name_of` raises."""
        return self.load(self.name_of(choice))

    def _installed(self) -> dict[str, str]:
        """Names of installed packages, with their "module:Class"."""
        from importlib.metadata import entry_points  # slow to import, and most runs need none

        return {point.name: point.value for point in entry_points(group=self.group)}

    def _checked(self, name: str, thing: Any) -> T:
        if self._base is None:
            fits, wanted = callable(thing), "a function"
        else:
            base = _attribute(import_module(self._base.partition(":")[0]), self._base)
            fits = isinstance(thing, base) or (isinstance(thing, type) and issubclass(thing, base))
            wanted = f"a {base.__name__}"
        if not fits:
            raise self._error(f"{self.noun} {name!r} must be {wanted}; got {thing!r}")
        return cast(T, thing)


def _attribute(module: Any, place: str) -> Any:
    return attrgetter(place.partition(":")[2])(module)


def _attribute_or_none(place: str) -> Any:
    module = sys.modules.get(place.partition(":")[0])
    try:
        return _attribute(module, place)
    except AttributeError:
        return None
