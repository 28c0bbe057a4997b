"""`make docs`: a site of every page of docs/, whole, that asks nothing of other hosts."""

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
    """The files that an entry of the navigation names."""
    if isinstance(entry, str):
        return [entry]
    return [name for part in (entry.values() if isinstance(entry, dict) else entry) for name in leaves(part)]


def test_the_navigation_names_every_page_once():
    assert sorted(leaves(tomllib.loads(SETTINGS.read_text())["project"]["nav"])) == [page.name for page in SITE]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built as `make docs` builds it. By name, its pages."""
    root = tmp_path_factory.mktemp("site")
    shutil.copy(SETTINGS, root)
    shutil.copytree(ROOT / "docs", root / "docs")
    build = [sys.executable, "-m", "zensical", "build", "--clean", "--strict"]
    done = subprocess.run(build, cwd=root, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return root / "site", {
        page.stem: HtmlPage((root / "site" / f"{page.stem}.html").read_text("utf-8")) for page in SITE
    }


def test_every_link_of_the_site_leads_to_a_file_and_to_a_place_in_it(site):
    folder, pages = site
    names = {stem: {own.get("id") for _, own in page.tags} for stem, page in pages.items()}
    for stem, page in pages.items():
        leads = [own[key] for tag, key in (("a", "href"), ("img", "src")) for own in page.all(tag) if key in own]
        for link in leads:
            if not link.startswith("https:"):
                name, _, anchor = link.partition("#")
                target = folder / (name or f"{stem}.html")
                assert target.exists(), (stem, link)
                assert not anchor or target.suffix != ".html" or unquote(anchor) in names[target.stem], (stem, link)


def test_a_page_loads_nothing_from_another_host(site):
    for stem, page in site[1].items():
        loaded = [own.get("src", "") for tag in ("script", "img", "iframe") for own in page.all(tag)]
        loaded += [own.get("href", "") for own in page.all("link")]
        assert loaded
        assert not [name for name in loaded if "//" in name], stem
