"""Freed memory in commands that compute with large tensors."""

import subprocess
import sys

import pytest

PROGRAM = """
import resource
import numpy as np
from retrieval.console.memory import keep_freed_memory

if {is_enabled}:
    keep_freed_memory()
np.ones(2**25)  # 256 MB
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(4):
    np.ones(2**25)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def page_faults(*, is_enabled: bool) -> int:
    """Return the page faults of four more arrays in a new process."""
    program = PROGRAM.format(is_enabled=is_enabled)
    return int(subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout)


@pytest.mark.parametrize(
    ("command", "expected"), [("train", True), ("build-index", True), ("serve", False), ("demo", False)]
)
def test_only_commands_that_compute_until_they_end_keep_freed_memory(command, expected):
    """The demo may end with the service, which must return its memory."""
    program = (
        "import sys\nfrom retrieval.commands import main\n"
        f"main.keep_freed_memory = lambda: print('kept')\nsys.argv = ['retrieve', {command!r}, '--help']\nmain.main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert (done.stdout.splitlines()[0] == "kept") == expected


@pytest.mark.skipif(sys.platform != "linux", reason="only the GNU C library returns freed memory like this")
def test_kept_memory_serves_the_next_large_array_without_page_faults():
    assert page_faults(is_enabled=True) < page_faults(is_enabled=False) / 10
