"""Waits for other threads and processes, all with a limit."""

import select
import subprocess
import threading
from contextlib import contextmanager


def wait_until(holds, limit_s=10.0):
    """Wait until `holds()` is true; fail after about `limit_s`.

    It does not use the clock or time.sleep, because tests replace them.
    """
    pause = threading.Event()
    for _ in range(int(limit_s / 0.002)):
        if holds():
            return
        pause.wait(0.002)
    raise AssertionError(f"the condition was not met within {limit_s:g} s")


@contextmanager
def run_process(command, **options):
    """Run a process with captured output; kill it at the end of the block, which would otherwise wait for it."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options) as process:
        try:
            yield process
        finally:
            process.kill()


def first_line(process, limit_s=60.0):
    """Return the first line that a process prints; empty if it ends without output."""
    if not select.select([process.stdout], [], [], limit_s)[0]:
        raise AssertionError(f"it printed nothing within {limit_s:g} s: {process.args}")
    return process.stdout.readline()
