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


DOCS = ROOT / "docs"


def test_the_navigation_contains_every_page_once():
    pages = sorted(page.relative_to(DOCS).as_posix() for page in SITE)
    assert sorted(leaves(tomllib.loads(SETTINGS.read_text())["project"]["nav"])) == pages


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site that `make docs` builds, and its pages by name."""
    root = tmp_path_factory.mktemp("site")
    shutil.copy(SETTINGS, root)
    shutil.copytree(ROOT / "docs", root / "docs")
    build = [sys.executable, "-m", "zensical", "build", "--clean", "--strict"]
    done = subprocess.run(build, cwd=root, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    files = [root / "site" / page.relative_to(DOCS).with_suffix(".html") for page in SITE]
    return root / "site", {file: HtmlPage(file.read_text("utf-8")) for file in files}


def test_every_link_of_the_site_leads_to_a_file_and_to_an_anchor_in_it(site):
    folder, pages = site
    names = {file: {attributes.get("id") for _, attributes in page.tags} for file, page in pages.items()}
    for file, page in pages.items():
        links = [
            attributes[key]
            for tag, key in (("a", "href"), ("img", "src"))
            for attributes in page.all(tag)
            if key in attributes
        ]
        for link in links:
            if not link.startswith("https:"):
                name, _, anchor = link.partition("#")
                target = (file.parent / name).resolve() if name else file
                assert target.exists(), (file, link)
                assert target.is_relative_to(folder), (file, link)
                assert not anchor or target not in names or unquote(anchor) in names[target], (file, link)


def test_a_page_loads_nothing_from_another_host(site):
    for file, page in site[1].items():
        loaded = [attributes.get("src", "") for tag in ("script", "img", "iframe") for attributes in page.all(tag)]
        loaded += [attributes.get("href", "") for attributes in page.all("link")]
        assert loaded
        assert not [name for name in loaded if "//" in name], file
