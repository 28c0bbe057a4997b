"""`make docs` builds a complete site from docs/ that loads nothing from other hosts."""

import shutil
import subprocess
import sys
import tomllib
from urllib.parse import unquote

import pytest

from tests.documents import ROOT, SITE
from tests.pages import HtmlPage

SETTINGS = ROOT / "zensical.toml"


def leaves(entry):
    """Return the files in an entry of the navigation."""
    if isinstance(entry, str):
        return [entry]
    return [name for part in (entry.values() if isinstance(entry, dict) else entry) for name in leaves(part)]


def test_the_navigation_contains_every_page_once():
    assert sorted(leaves(tomllib.loads(SETTINGS.read_text())["project"]["nav"])) == [page.name for page in SITE]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site that `make docs` builds, and its pages by name."""
    root = tmp_path_factory.mktemp("site")
    shutil.copy(SETTINGS, root)
    shutil.copytree(ROOT / "docs", root / "docs")
    build = [sys.executable, "-m", "zensical", "build", "--clean", "--strict"]
    done = subprocess.run(build, cwd=root, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return root / "site", {
        page.stem: HtmlPage((root / "site" / f"{page.stem}.html").read_text("utf-8")) for page in SITE
    }


def test_every_link_of_the_site_leads_to_a_file_and_to_an_anchor_in_it(site):
    folder, pages = site
    names = {stem: {attributes.get("id") for _, attributes in page.tags} for stem, page in pages.items()}
    for stem, page in pages.items():
        links = [
            attributes[key]
            for tag, key in (("a", "href"), ("img", "src"))
            for attributes in page.all(tag)
            if key in attributes
        ]
        for link in links:
            if not link.startswith("https:"):
                name, _, anchor = link.partition("#")
                target = folder / (name or f"{stem}.html")
                assert target.exists(), (stem, link)
                assert not anchor or target.suffix != ".html" or unquote(anchor) in names[target.stem], (stem, link)


def test_a_page_loads_nothing_from_another_host(site):
    for stem, page in site[1].items():
        loaded = [attributes.get("src", "") for tag in ("script", "img", "iframe") for attributes in page.all(tag)]
        loaded += [attributes.get("href", "") for attributes in page.all("link")]
        assert loaded
        assert not [name for name in loaded if "//" in name], stem
