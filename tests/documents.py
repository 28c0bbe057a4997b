"""Blocks, links and headings in README, docs/, CONTRIBUTING and the notebooks."""

import json
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
README, CONTRIBUTING = ROOT / "README.md", ROOT / "CONTRIBUTING.md"
SITE = tuple(sorted((ROOT / "docs").rglob("*.md")))
"""The pages of docs/, from which `make docs` builds the site."""
PAGES = (README, *SITE)
RUN_TOGETHER = tuple(page for page in PAGES if page.stem != "extending")
"""The pages whose blocks run in one folder; tests/project/test_extending.py runs those of the other page."""
NOTEBOOKS = tuple(sorted((ROOT / "notebooks").glob("*.ipynb")))


def text_of(page):
    """Return the Markdown of a page, or of the cells of a notebook."""
    text = page.read_text("utf-8")
    if page.suffix != ".ipynb":
        return text
    return "\n\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown")


def blocks(language, *pages):
    """Return the code blocks of pages in one language; without pages, of all in RUN_TOGETHER."""
    return [
        block
        for page in pages or RUN_TOGETHER
        for block in re.findall(rf"```{language}\n(.*?)```", text_of(page), re.S)
    ]


def table_rows(page):
    """Return the cells of every line of every table."""
    lines = [line for line in text_of(page).splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def links(page):
    """Return the targets of links and pictures."""
    return re.findall(r"\]\(([^)\s]+)\)", _without_blocks(page))


def anchors(page):
    """Return the anchors of headings that are the same in GitHub and in Python-Markdown."""
    headings = re.findall(r"^#+ (.*)$", _without_blocks(page), re.M)
    plain = [re.sub(r"[^\w\s-]", "", heading).strip().lower() for heading in headings]
    return {re.sub(r"\s", "-", words) for words in plain} & {re.sub(r"[-\s]+", "-", words) for words in plain}


def _without_blocks(page):
    return re.sub(r"^```.*?^```", "", text_of(page), flags=re.M | re.S)
