"""Paths of real data, for tests that need them."""

import os
from pathlib import Path

import pytest


def touch_data(relative: str) -> Path:
    """Return a file or folder of the real data, or skip the test if it is missing."""
    root = Path(os.environ.get("TOUCH_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"))
    path = root / relative
    if not path.exists():
        pytest.skip(f"real data are missing: no {relative} under TOUCH_DATA")
    return path
