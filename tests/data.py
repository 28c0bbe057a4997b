"""Paths of real data, for tests that need them."""

import os
from pathlib import Path

import pytest


def touch_data(relative: str) -> Path:
    """Return a file or folder of the real data, or skip the test if it is missing."""
    if not (root := os.environ.get("TOUCH_DATA")):
        pytest.skip("real data are missing: the variable TOUCH_DATA is not set")
    path = Path(root) / relative
    if not path.exists():
        pytest.skip(f"real data are missing: {path} does not exist")
    return path
