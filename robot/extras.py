"""Packages that only one driver or importer needs."""

from importlib import import_module
from typing import Any

from robot.errors import ImporterError, RobotError


def import_extra(name: str, purpose: str, extra: str = "importers", error: type[RobotError] = ImporterError) -> Any:
    """Import the module `name`, which `purpose` needs and `extra` installs; raise `error` without it."""
    try:
        return import_module(name)
    except ImportError as cause:
        raise error(
            f"{purpose} needs {name}, which is missing or incomplete ({cause}); run pip install "
            f"'touch-retrieval[{extra}]'"
        ) from cause
