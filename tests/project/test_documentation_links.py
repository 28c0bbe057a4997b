"""Links and names in README, docs/, CONTRIBUTING and the notebooks exist."""

import pkgutil
import re
import tomllib

import pytest

from tests.documents import CONTRIBUTING, NOTEBOOKS, PAGES, README, ROOT, SITE, anchors, links, table_rows, text_of

LINKED = (*PAGES, CONTRIBUTING, *NOTEBOOKS)
OURS = r"(?:retrieval|robot|indexes|tests|benchmarks)"


@pytest.mark.parametrize("page", LINKED, ids=lambda page: page.stem)
def test_every_link_leads_to_a_file_and_to_a_heading_in_it(page):
    for link in links(page):
        if not link.startswith("http"):
            name, _, anchor = link.partition("#")
            target = (page.parent / name).resolve() if name else page
            assert target.exists(), link
            assert not anchor or anchor in anchors(target), link


def test_the_tables_of_the_readme_are_parts_of_those_in_the_pages():
    """Each row occurs in a page with the same first cell and its other cells in the same order."""
    documented = [row for page in SITE for row in table_rows(page)]
    shown = table_rows(README)
    assert len(shown) > 15
    for first, *cells in shown:
        candidates = [iter(row[1:]) for row in documented if row[0] == first]
        assert any(all(cell in rest for cell in cells) for rest in candidates), first


@pytest.mark.parametrize("page", [*PAGES, CONTRIBUTING], ids=lambda page: page.stem)
def test_every_file_name_and_extra_of_the_project_in_a_page_exists(page):
    text = text_of(page)
    for name in re.findall(rf"(?<![\w/]){OURS}/[\w./*-]*(?:\.\w+|/)", text):
        assert list(ROOT.glob(name.rstrip("/"))), name
    for name in re.findall(r"`((?:retrieval|robot|indexes)(?:\.[A-Za-z_]\w*)+)`", text):
        assert pkgutil.resolve_name(name), name
    known = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = re.findall(r"touch-retrieval\[([\w,]+)\]", text)
    assert {extra for extras in named for extra in extras.split(",")} <= set(known)
