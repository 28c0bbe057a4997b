"""Text of spreadsheets, editors and scripts is read in any of their encodings and forms, or refused by what to do."""

import json

import numpy as np
import pytest

import robot
from _touch_retrieval.files import read_json
from retrieval.data.catalogue import list_catalogue
from retrieval.errors import DatasetError
from retrieval.model.config import load_config
from robot.errors import RobotConfigError
from robot.sight.hand_eye import COLUMNS, read_pairs
from tests.as_they_come import write_pictures

ENCODINGS = ("utf-8", "utf-8-sig", "utf-16")  # a script; Windows; PowerShell and "Unicode text" of Excel
POINTS = np.arange(12).reshape(2, 6) - 0.5
ROWS = [[*map(str, row)] for row in POINTS]
TABLES = {
    "Excel in Germany": [";".join(COLUMNS), *(";".join(row).replace(".", ",") + ";" for row in ROWS), ";;;;;;"],
    "a hint for Excel": ["sep=;", ";".join(COLUMNS), *(";".join(row) for row in ROWS)],
    "numpy.savetxt": ["# " + " ".join(COLUMNS), *(" ".join(row) for row in ROWS)],
    "tabs": ["\t".join(["point", *COLUMNS[::-1]]), *("\t".join(["corner", *row[::-1]]) for row in ROWS)],
    "typed": [", ".join(COLUMNS).replace("c", "C"), "", *(", ".join(row).replace("-", "\u2212") for row in ROWS)],
}
REFUSED = {
    "camera_x_mm;camera_y_mm\n1;2": r"camera_z_mm.*it has camera_x_mm, camera_y_mm",
    ",".join(COLUMNS) + "\n1,5,2,5,3,5,1,5,2,5,3,5": "line 2: it has 12 cells for 6 columns",
    "": "it lacks the columns camera_x_mm.*it has none",
    ",".join(COLUMNS) + "\n1,2,3,4,5": "line 2: rig_z_mm: could not convert",
    ",".join(COLUMNS) + "\n1,2,3,4,5,six": "line 2: rig_z_mm: could not convert",
    ",".join(COLUMNS) + "\n1,2,3,4,5,inf": "line 2: rig_z_mm: must be a finite number",
    ",".join(COLUMNS) + '\n1,2,3,4,5,"6"7': "line 2: it is not CSV",
    ",".join(COLUMNS) + '\n"1,234",2,3,4,5,6': "thousands",
    ";".join(COLUMNS) + "\n1.234;2,5;3;4;5;6": "thousands",
    ";".join([*COLUMNS, COLUMNS[0]]) + "\n1;2;3;4;5;6;7": "twice",
}


def check(folder, get):
    file = folder / "text"
    for encoding in ENCODINGS:
        for lines in TABLES.values():
            for end in ("\n", "\r\n", "\r"):
                file.write_bytes(end.join(lines).encode(encoding))
                np.testing.assert_array_equal(np.hstack(read_pairs(file)), POINTS)
        toml, document = folder / "x.toml", folder / "x.json"
        toml.write_bytes(b'rig = "sim"\r\nfingers = ["a"]\r\n'.decode().encode(encoding))
        assert list(robot.load_rig(str(toml), seed=0).sensors) == ["a"]
        toml.write_bytes("[training]\r\niterations = 7\r\n".encode(encoding))
        assert load_config(str(toml)).training.iterations == 7
        document.write_bytes('{"seed": 3}'.encode(encoding))
        assert read_json(document) == {"seed": 3}
    for text, message in REFUSED.items():
        file.write_text(text)
        with pytest.raises(RobotConfigError, match=message):
            read_pairs(file)
    file.write_bytes("Stoff;grün".encode("cp1252"))
    with pytest.raises(RobotConfigError, match="UTF-8"):
        read_pairs(file)

    catalogue = write_pictures(folder / "catalog", "grün/1.jpg")
    metadata = catalogue / "metadata.jsonl"
    row = {"file_name": "grün\\1.jpg", "title": "a\u2028b"}  # as a script writes it on Windows
    for encoding in ENCODINGS:
        metadata.write_bytes((json.dumps(row, ensure_ascii=False) + "\r\n").encode(encoding))
        found = list_catalogue(catalogue)
        assert found.notes == ()
        assert found.photos[0].metadata == {"title": "a\u2028b"}
    for text in ('[{"object_id": "grün"}]', '{"object_id": "grün"},', '{"object_id": "grün", "price": NaN}'):
        metadata.write_text(text, "utf-8")
        with pytest.raises(DatasetError, match="one JSON object a line"):
            list_catalogue(catalogue)
