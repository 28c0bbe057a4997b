"""Links and names in README, docs/, CONTRIBUTING and the notebooks exist."""

import pkgutil
import re
import tomllib

import pytest

from tests.documents import CONTRIBUTING, NOTEBOOKS, PAGES, README, ROOT, SITE, anchors, links, text_of

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


def intervals(text):
    """Return each value with an interval, in percent: 0.123 [0.1, 0.2] and 12.3 % [10, 20] are (12.3, 10, 20)."""
    written = re.findall(r"(\d*\.?\d+)(?: %)? \[([\d.]+), ([\d.]+)\]", text)
    values = [tuple(map(float, numbers)) for numbers in written]
    return {tuple(round(number * (100 if max(value) <= 1 else 1), 1) for number in value) for value in values}


def test_the_results_of_the_readme_are_those_of_the_pages():
    shown = intervals(text_of(README))
    assert len(shown) > 10
    assert shown <= {value for page in SITE for value in intervals(text_of(page))}


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
