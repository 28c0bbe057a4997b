"""Packages that only one driver or importer needs: their import, and their exceptions as DeviceError."""

import contextlib
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from robot.errors import DeviceError, ImporterError, RobotError


def import_extra(name: str, purpose: str, extra: str = "importers", error: type[RobotError] = ImporterError) -> Any:
    """Import the module `name`, which `purpose` needs and `extra` installs; raise `error` without it."""
    try:
        return import_module(name)
    except ImportError as cause:
        raise error(
            f"{purpose} needs {name}, which is missing or incomplete ({cause}); run pip install "
            f"'touch-retrieval[{extra}]'"
        ) from cause


@contextlib.contextmanager
def package_errors(failure: str) -> Iterator[None]:
    """Convert exceptions of a package or program into a DeviceError that begins with `failure`; OSError passes."""
    try:
        yield
    except (DeviceError, OSError):
        raise
    except Exception as error:
        raise DeviceError(f"{failure}: {error or type(error).__name__}") from error
