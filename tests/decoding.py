"""Replacements of `serve_pictures` in the processes of `retrieval.serve.decoders`."""

import os
import signal
import time
from pathlib import Path

from retrieval.data.images import MAX_PIXELS
from retrieval.serve import decoders

HANG = "from tests.decoding import hang_on_large; hang_on_large()"
DIE = "from tests.decoding import die_of_large; die_of_large()"
FAIL = "raise SystemExit"
read_gel_image = decoders.read_gel_image


def die_of_large():
    """Kill the process at a large picture, as the system would."""

    def read(data, name, px, max_pixels):
        if max_pixels == MAX_PIXELS:
            os.kill(os.getpid(), signal.SIGKILL)
        return read_gel_image(data, name, px, max_pixels)

    decoders.read_gel_image = read
    decoders.serve_pictures()


def hang_on_large():
    """Hang at a large picture; its name is a file for the process id."""

    def read(data, name, px, max_pixels):
        if max_pixels == MAX_PIXELS:
            Path(name).write_text(str(os.getpid()))
            time.sleep(600)
        return read_gel_image(data, name, px, max_pixels)

    decoders.read_gel_image = read
    decoders.serve_pictures()
