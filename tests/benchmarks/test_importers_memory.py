"""An import's memory grows with its rows by their names only: `python -m benchmarks.importers_memory`."""

import re
from pathlib import Path

import pytest

from benchmarks.importers_memory import MAX_KB, WIDE, growth_kb, peak_mb
from robot.importers import IMPORTERS

FEW, MANY = 1000, 6000
SPREAD_MB = 4
"""By which two runs of the same rows differ."""
CODEC = "lerobot"
"""Its decoder of videos fills buffers over some ten thousand rows: shown by the command alone."""


def test_rows_are_drawn_for_every_importer():
    assert {re.sub(r" \(.*", "", name) for name in WIDE} == set(IMPORTERS)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
@pytest.mark.parametrize("name", [name for name in WIDE if name != CODEC])
def test_memory_grows_by_the_names_of_rows_alone(name):
    peaks = {rows: peak_mb(name, rows) for rows in (FEW, MANY)}
    spread_kb = 1000 * SPREAD_MB / (MANY - FEW)
    for what, most in MAX_KB.items():
        assert growth_kb(peaks, what) < most + spread_kb, peaks
