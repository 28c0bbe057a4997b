"""Waiting for what another thread or process does: every wait ends."""

import select
import subprocess
import threading
from contextlib import contextmanager

STARTED = ([], ["sh", "-c", "trap '' INT; exec \"$@\"", "sh"])
STARTED_IDS = ("from a terminal", "ignoring Ctrl-C")
"""What stands before a command: nothing, or what has it ignore Ctrl-C as nohup and `&` in a script do."""


def wait_until(holds, limit_s=10.0):
    """Wait until something has happened; a failure where it has not within about `limit_s`.

    Not by the clock or time.sleep, which tests replace.
    """
    pause = threading.Event()
    for _ in range(int(limit_s / 0.002)):
        if holds():
            return
        pause.wait(0.002)
    raise AssertionError("what was waited for did not happen")


@contextmanager
def run_process(command, **options):
    """A process with its output at hand; killed at the latest when this is left, which would else wait for its end."""
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options) as process:
        try:
            yield process
        finally:
            process.kill()


def first_line(process, limit_s=60.0):
    """The first line that a process prints; empty where it ends without one."""
    if not select.select([process.stdout], [], [], limit_s)[0]:
        raise AssertionError(f"it printed nothing within {limit_s:g} s: {process.args}")
    return process.stdout.readline()
