"""Public names of a package that are imported on first use, so that importing the package is cheap."""

from collections.abc import Callable, Mapping
from importlib import import_module
from operator import attrgetter
from typing import Any


def lazy_names(package: str, places: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the functions `__getattr__` and `__dir__` of a package.

    Args:
        package: Its name.
        places: Public name -> "module" that has this name, or "module:attribute", in the package.
    """

    def find(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, attribute = places[name].partition(":")
        return attrgetter(attribute or name)(import_module(f"{package}.{module}"))

    return find, lambda: sorted({*vars(import_module(package)), *places})
