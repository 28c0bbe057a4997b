"""What takes the place of `serve_pictures` in the processes of `retrieval.serve.decoders`."""

import os
import signal
import time
from pathlib import Path

from retrieval.data.images import MAX_PIXELS
from retrieval.serve import decode_process

HANG = "from tests.decoding import hang_on_large; hang_on_large()"
DIE = "from tests.decoding import die_of_large; die_of_large()"
FAIL = "raise SystemExit"
read_gel_image = decode_process.read_gel_image


def die_of_large():
    """The process is ended by a large picture, as by the system."""

    def read(data, name, px, compares_contact, max_pixels):
        if max_pixels == MAX_PIXELS:
            os.kill(os.getpid(), signal.SIGKILL)
        return read_gel_image(data, name, px, compares_contact, max_pixels)

    decode_process.read_gel_image = read
    decode_process.serve_pictures()


def hang_on_large():
    """A large picture, whose name is a file to write the process's id to, is decoded for ever."""

    def read(data, name, px, compares_contact, max_pixels):
        if max_pixels == MAX_PIXELS:
            Path(name).write_text(str(os.getpid()))
            time.sleep(600)
        return read_gel_image(data, name, px, compares_contact, max_pixels)

    decode_process.read_gel_image = read
    decode_process.serve_pictures()
