"""Inputs as people have them: from cameras, shops, spreadsheets, network drives and other programs.

A case is a folder with a `case.py`: its docstring says in a sentence what must be true, and its function `check` makes
it sure. Files next to it, such as a table of a spreadsheet, are the case's input. `test_cases` runs all of them.
"""

import io

import numpy as np
from PIL import Image


def write_pictures(folder, *paths, kind="PNG"):
    """Write a different small picture at each path below a folder, whatever the name says; return the folder."""
    for number, path in enumerate(paths):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        buffer = io.BytesIO()
        Image.fromarray(np.random.default_rng(number).integers(0, 256, (8, 8, 3), np.uint8)).save(buffer, kind)
        (folder / path).write_bytes(buffer.getvalue())
    return folder
