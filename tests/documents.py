"""README, docs/, CONTRIBUTING and the notebooks as texts with blocks, links and headings."""

import json
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
README, CONTRIBUTING = ROOT / "README.md", ROOT / "CONTRIBUTING.md"
SITE = tuple(sorted((ROOT / "docs").glob("*.md")))
"""The pages of docs/, of which `make docs` makes the site."""
PAGES = (README, *SITE)
RUN_TOGETHER = tuple(page for page in PAGES if page.stem != "extending")
"""The pages whose blocks are run in one folder; tests/project/test_extending.py runs those of the other."""
NOTEBOOKS = tuple(sorted((ROOT / "notebooks").glob("*.ipynb")))


def text_of(page):
    """The Markdown of a page, or of a notebook's cells."""
    text = page.read_text("utf-8")
    if page.suffix != ".ipynb":
        return text
    return "\n\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown")


def blocks(language, *pages):
    """The code blocks of pages (of all that run together, where none is named) in one language."""
    return [
        block
        for page in pages or RUN_TOGETHER
        for block in re.findall(rf"```{language}\n(.*?)```", text_of(page), re.S)
    ]


def table_rows(page):
    """The cells of every line of every table."""
    lines = [line for line in text_of(page).splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def links(page):
    """Where links and pictures lead: the text in the parentheses."""
    return re.findall(r"\]\(([^)\s]+)\)", _without_blocks(page))


def anchors(page):
    """What may follow "#": headings as both GitHub and Python-Markdown call them, where the two agree."""
    headings = re.findall(r"^#+ (.*)$", _without_blocks(page), re.M)
    plain = [re.sub(r"[^\w\s-]", "", heading).strip().lower() for heading in headings]
    return {re.sub(r"\s", "-", words) for words in plain} & {re.sub(r"[-\s]+", "-", words) for words in plain}


def _without_blocks(page):
    return re.sub(r"^```.*?^```", "", text_of(page), flags=re.M | re.S)
