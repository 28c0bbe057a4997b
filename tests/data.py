"""Where real data lie, for the tests that want them."""

import os
from pathlib import Path

import pytest


def touch_data(relative: str) -> Path:
    """A file or folder of the real data, or a skip that says what is missing."""
    root = Path(os.environ.get("TOUCH_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"))
    path = root / relative
    if not path.exists():
        pytest.skip(f"real data are not at hand: no {relative} under TOUCH_DATA")
    return path
