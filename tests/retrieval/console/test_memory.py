"""Freed memory in commands that compute with large tensors."""

import subprocess
import sys

import pytest

FAULTS = """
import resource
import numpy as np
from retrieval.console.memory import keep_freed_memory

def faults():
    np.ones(2**23)  # 64 MB
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(4):
        np.ones(2**23)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

before = faults()
keep_freed_memory()
print(before, faults())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="only the GNU C library returns freed memory like this")
def test_kept_memory_serves_the_next_large_array_without_page_faults():
    done = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True)
    before, after = map(int, done.stdout.split())
    assert after < before / 10
