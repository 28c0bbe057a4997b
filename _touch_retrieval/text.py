"""Text files that people made: the one reader of what editors, spreadsheets and scripts write.

TOML, JSON, JSON lines and CSV are UTF-8, or any UTF with a byte-order mark, as Windows and Excel write it. Lines may
end as on any system.
"""

import codecs
import csv
import io
import math
from collections.abc import Sequence
from itertools import zip_longest

_MARKS = {  # that of UTF-32 begins like that of UTF-16
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF32_LE: "utf-32-le",
    codecs.BOM_UTF32_BE: "utf-32-be",
    codecs.BOM_UTF16_LE: "utf-16-le",
    codecs.BOM_UTF16_BE: "utf-16-be",
}


def decode_text(data: bytes) -> str:
    """Return the text of a file, without byte-order mark, with the line ends of Unix.

    Raises:
        ValueError: It has another encoding. The message names the line.
    """
    mark = next((mark for mark in _MARKS if data.startswith(mark)), b"")
    content = data.removeprefix(mark)
    try:
        text = content.decode(_MARKS.get(mark, "utf-8"))
    except UnicodeDecodeError as error:
        line = 1 + content.count(b"\n", 0, error.start)
        raise ValueError(f"line {line}: it is not UTF-8 text; save it as UTF-8, in Excel as CSV UTF-8") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_numbers(data: bytes, columns: Sequence[str]) -> list[list[float]]:
    r"""Return the numbers in some columns of a CSV file, row by row.

    The first line of the file names its columns, in any order and among others. Cells are separated by commas,
    semicolons, tabs, bars or spaces, as this line shows. Spaces around a cell, the case of column names and empty rows
    do not matter. A comma is the decimal mark unless commas separate the cells.

    Args:
        data: Content of the file.
        columns: Names of the required columns, in lower case.

    Raises:
        ValueError: It is no such table, a cell is no finite number, or numbers may have separators of thousands. The
            message names the missing columns and those that were found, or the line and the column.

    >>> read_numbers(b"Shelf;Width\n B 4;1,5\n", ["width"])
    [[1.5]]
    """
    rows, delimiter = _read_rows(decode_text(data), columns)
    marks = {mark for _, row in rows for column in columns for mark in ",." if mark in row[column]}
    numbers = []
    for line, row in rows:
        for column in columns:
            try:
                if len(marks) > 1:
                    raise ValueError("some numbers have a comma and some a point; remove separators of thousands")
                numbers.append(_number(row[column], delimiter))
            except ValueError as error:
                raise ValueError(f"line {line}: {column}: {error}") from error
    return [numbers[at : at + len(columns)] for at in range(0, len(numbers), len(columns))]


def _number(text: str, delimiter: str) -> float:
    if "," in text and (delimiter == "," or "." in text):
        raise ValueError(f"must be a number without separators of thousands, got {text!r}")
    number = float(text.replace(",", ".").replace("\N{MINUS SIGN}", "-"))
    if not math.isfinite(number):
        raise ValueError(f"must be a finite number, got {text!r}")
    return number


def _read_rows(text: str, columns: Sequence[str]) -> tuple[list[tuple[int, dict[str, str]]], str]:
    """Return (number of the line, column -> text) of each row that is not empty, and what separates the cells."""
    head, _, rest = text.partition("\n")
    if skipped := head.lower().startswith("sep="):  # a hint for Excel
        text, head = rest, rest.partition("\n")[0]
    delimiter = next((mark for mark in ";\t|," if mark in head), " ")
    text = text.removeprefix("#")  # as numpy.savetxt begins it
    reader = csv.reader(io.StringIO(text), delimiter=delimiter, skipinitialspace=True, strict=True)
    try:
        lines = [(reader.line_num + skipped, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num + skipped}: it is not CSV: {error}") from error
    names = [name.casefold() for name in lines.pop(0)[1]] if lines else []
    if lacking := [column for column in columns if column not in names]:
        raise ValueError(f"it lacks the columns {', '.join(lacking)}; it has {', '.join(names) or 'none'}")
    if twice := [name for name in columns if names.count(name) > 1]:
        raise ValueError(f"it has the column {twice[0]} twice")
    rows = [(line, row) for line, row in lines if any(row)]
    for line, row in rows:
        if any(row[len(names) :]):
            raise ValueError(f"line {line}: it has {len(row)} cells for {len(names)} columns")
    return [(line, dict(zip_longest(names, row[: len(names)], fillvalue=""))) for line, row in rows], delimiter
