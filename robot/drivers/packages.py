"""Packages that only one driver needs: their import, and their exceptions as DeviceError."""

import contextlib
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from robot.errors import DeviceError


def import_package(name: str, device: str, extra: str) -> Any:
    """Import the module `name`, which `device` requires and `extra` installs; raise DeviceError if it is missing."""
    try:
        return import_module(name)
    except ImportError as error:
        raise DeviceError(
            f"{device} requires {name}, which is missing or incomplete ({error}); run pip install "
            f"'touch-retrieval[{extra}]'"
        ) from error


@contextlib.contextmanager
def package_errors(failure: str) -> Iterator[None]:
    """Convert exceptions of a package or program into a DeviceError that begins with `failure`; OSError passes."""
    try:
        yield
    except (DeviceError, OSError):
        raise
    except Exception as error:
        raise DeviceError(f"{failure}: {error or type(error).__name__}") from error
