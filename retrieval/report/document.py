"""Documents of headings, paragraphs, tables and figures, written as Markdown and as one HTML page.

Both are made from the same blocks, so their contents agree. Every report is such a document: of an evaluation, of error
against run time, of hard cases.
"""

import json
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from PIL import Image

from retrieval.console.files import text_bytes, write_output
from retrieval.report.canvas import FIGURE_DPI, Figure, draw
from retrieval.report.pages import data_uri, render, script

_PAGE_DPI = 96


@dataclass(frozen=True)
class Text:
    """A paragraph; `warn` highlights it."""

    kind: ClassVar[str] = "text"
    text: str
    warn: bool = False


@dataclass(frozen=True)
class Listing:
    """Preformatted text."""

    kind: ClassVar[str] = "listing"
    text: str

    @classmethod
    def of_json(cls, data: Any) -> "Listing":
        """Return data of JSON types as text, one item per line."""
        return cls(json.dumps(data, indent=2, sort_keys=True, ensure_ascii=False))


@dataclass(frozen=True)
class Table:
    """A table of plain text cells.

    Attributes:
        header: Column headings.
        rows: Cells of each row.
        notes: Paragraphs below the table.
        words: Columns of text, which are left-aligned.
    """

    kind: ClassVar[str] = "table"
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()
    words: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Picture:
    """A figure, written to figures/NAME.png next to the document.

    Attributes:
        name: Name of the file.
        alt: Text alternative.
        caption: Text below the figure.
        figure: Function that draws it.
    """

    kind: ClassVar[str] = "picture"
    name: str
    alt: str
    caption: str
    figure: Callable[[], Figure]

    @property
    def file(self) -> str:
        """Path of the file, relative to the document."""
        return f"figures/{self.name}.png"


@dataclass(frozen=True)
class Details:
    """Blocks that a page shows folded."""

    kind: ClassVar[str] = "details"
    title: str
    blocks: tuple["Block", ...]


Block = Text | Listing | Table | Picture | Details


@dataclass(frozen=True)
class Section:
    """A heading and its blocks."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Document:
    """A title, leading blocks, and sections."""

    title: str
    lead: tuple[Block, ...]
    sections: tuple[Section, ...]

    def pictures(self) -> list[Picture]:
        """Return all pictures, also those in folded blocks."""
        return list(_pictures([*self.lead, *(block for section in self.sections for block in section.blocks)]))


def _pictures(blocks: Iterable[Block]) -> Iterator[Picture]:
    for block in blocks:
        if isinstance(block, Picture):
            yield block
        elif isinstance(block, Details):
            yield from _pictures(block.blocks)


def write_document(document: Document, out: Path, name: str = "report") -> list[Path]:
    """Write a document as NAME.md, NAME.html and figures/.

    Args:
        document: The document.
        out: Folder to write to.
        name: Name of the files.

    Returns:
        The paths: Markdown, page, figures.

    Raises:
        RetrievalError: The document has pictures, and matplotlib is not installed.
    """
    figures = {out / picture.file: picture for picture in document.pictures()}
    for path, picture in figures.items():
        draw(path, picture.figure)
    text, page = out / f"{name}.md", out / f"{name}.html"
    write_output(text, text_bytes(to_markdown(document)))
    write_output(page, text_bytes(to_html(document, out)))
    return [text, page, *figures]


# HTML ------------------------------------------------------------------------------------------------


def to_html(document: Document, folder: Path) -> str:
    """Return one HTML page that embeds the figures under `folder`."""

    def uri(picture: Picture) -> str:
        return data_uri((folder / picture.file).read_bytes(), "png")

    def width(picture: Picture) -> int:
        """Return the width of a figure on the page, so that the letters of all figures have one size."""
        with Image.open(folder / picture.file) as image:
            return round(image.width * _PAGE_DPI / FIGURE_DPI)

    def anchor(title: str) -> str:
        return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")

    return render("document.html", document=document, uri=uri, width=width, anchor=anchor, script=script("tables.js"))


# Markdown --------------------------------------------------------------------------------------------


def to_markdown(document: Document) -> str:
    """Return the document as GitHub Markdown; pictures are links to their files."""
    parts = [f"# {_plain(document.title)}", *_blocks(document.lead, 2)]
    for section in document.sections:
        parts += [f"## {_plain(section.title)}", *_blocks(section.blocks, 3)]
    return "\n\n".join(parts) + "\n"


def _blocks(blocks: tuple[Block, ...], level: int) -> Iterator[str]:
    for block in blocks:
        if isinstance(block, Details):
            yield f"{'#' * level} {_plain(block.title)}"
            yield from _blocks(block.blocks, level + 1)
        elif isinstance(block, Text):
            yield f"> {_plain(block.text)}" if block.warn else _plain(block.text)
        elif isinstance(block, Listing):
            yield "\n".join(f"    {line}" for line in block.text.splitlines())
        elif isinstance(block, Picture):
            yield f"![{_plain(block.alt)}]({block.file})"
            yield _plain(block.caption)
        else:
            ruler = ["---" if column in block.words | {0} else "---:" for column in range(len(block.header))]
            lines = [block.header, ruler, *(map(_plain, row) for row in block.rows)]
            yield "\n".join(f"| {' | '.join(line)} |" for line in lines)
            yield from map(_plain, block.notes)


def _plain(text: str) -> str:
    """Return the text on one line, with the markup characters of Markdown and HTML escaped."""
    return re.sub(r"([\\`*_\[\]|<>&])", r"\\\1", " ".join(text.split()))


def capitalized(label: str) -> str:
    """Return the label with an upper-case first letter; CCA stays CCA."""
    return label[:1].upper() + label[1:]
