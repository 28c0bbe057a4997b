"""Documents of headings, paragraphs, tables and pictures, written as Markdown and as one HTML page.

Both are made from the same blocks, so their contents agree. Every report and the page of a query is such a document.
"""

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import jinja2
from PIL import Image

from retrieval.console.files import write_output
from retrieval.report.canvas import FIGURE_DPI, Figure, draw
from retrieval.report.pages import data_uri

_PAGE_DPI = 96


@dataclass(frozen=True)
class Text:
    """A paragraph; `warn` highlights it."""

    text: str
    warn: bool = False


@dataclass(frozen=True)
class Table:
    """A table of plain text cells, with paragraphs below it; the columns `words` contain text and are left-aligned."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()
    words: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Picture:
    """A figure, written to figures/NAME.png next to the document, with a text alternative and a caption."""

    name: str
    alt: str
    caption: str
    figure: Callable[[], Figure]

    @property
    def file(self) -> str:
        """Path of the file, relative to the document."""
        return f"figures/{self.name}.png"


@dataclass(frozen=True)
class Card:
    """A frame with pictures, a title and lines of text.

    Attributes:
        pictures: Data URI and text alternative of each picture; an empty URI leaves a blank.
        title: Title, in bold.
        lines: Lines below the title.
        is_marked: Whether the frame is highlighted.
    """

    pictures: tuple[tuple[str, str], ...]
    title: str
    lines: tuple[str, ...]
    is_marked: bool = False


@dataclass(frozen=True)
class Cards:
    """Cards next to each other; Markdown has their text only."""

    cards: tuple[Card, ...]


@dataclass(frozen=True)
class Section:
    """A heading and blocks; a page shows a section within another one folded."""

    title: str
    blocks: tuple["Block", ...]


Block = Text | Table | Picture | Cards | Section


@dataclass(frozen=True)
class Document:
    """A title and blocks."""

    title: str
    blocks: tuple[Block, ...]


def write_document(document: Document, out: Path, name: str = "report") -> list[Path]:
    """Write a document as NAME.md, NAME.html and figures/ in the folder `out`; return the paths in this order.

    Raises:
        RetrievalError: The document has figures, and matplotlib is not installed.
    """
    figures = {out / picture.file: picture for picture in _pictures(document.blocks)}
    for path, picture in figures.items():
        draw(path, picture.figure)
    text, page = out / f"{name}.md", out / f"{name}.html"
    write_output(text, to_markdown(document))
    write_output(page, to_html(document, out))
    return [text, page, *figures]


def _pictures(blocks: Iterable[Block]) -> Iterator[Picture]:
    for block in blocks:
        if isinstance(block, Picture):
            yield block
        elif isinstance(block, Section):
            yield from _pictures(block.blocks)


# HTML ------------------------------------------------------------------------------------------------


def to_html(document: Document, folder: Path) -> str:
    """Return one HTML page that embeds the figures under `folder`; all text is escaped."""

    def uri(picture: Picture) -> str:
        return data_uri((folder / picture.file).read_bytes(), "png")

    def width(picture: Picture) -> int:
        """Return the width of a figure on the page, so that the letters of all figures have one size."""
        with Image.open(folder / picture.file) as image:
            return round(image.width * _PAGE_DPI / FIGURE_DPI)

    templates = jinja2.PackageLoader("retrieval")
    environment = jinja2.Environment(loader=templates, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.get_template("document.html").render(document=document, uri=uri, width=width)


# Markdown --------------------------------------------------------------------------------------------


def to_markdown(document: Document) -> str:
    """Return the document as GitHub Markdown; figures are links to their files."""
    return "\n\n".join([f"# {_plain(document.title)}", *_blocks(document.blocks, 2)]) + "\n"


def _blocks(blocks: tuple[Block, ...], level: int) -> Iterator[str]:
    for block in blocks:
        if isinstance(block, Section):
            yield f"{'#' * level} {_plain(block.title)}"
            yield from _blocks(block.blocks, level + 1)
        elif isinstance(block, Text):
            yield f"> {_plain(block.text)}" if block.warn else _plain(block.text)
        elif isinstance(block, Picture):
            yield f"![{_plain(block.alt)}]({block.file})"
            yield _plain(block.caption)
        elif isinstance(block, Cards):
            yield "\n".join(f"* **{_plain(card.title)}** {_plain('; '.join(card.lines))}" for card in block.cards)
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
