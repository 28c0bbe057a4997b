"""Waiting for what another thread or process does."""

import threading


def until(holds, limit_s=10.0):
    """Wait until something has happened; a failure where it has not within about `limit_s`.

    Not by the clock or time.sleep, which tests replace.
    """
    pause = threading.Event()
    for _ in range(int(limit_s / 0.002)):
        if holds():
            return
        pause.wait(0.002)
    raise AssertionError("what was waited for did not happen")
