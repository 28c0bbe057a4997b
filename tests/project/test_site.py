"""`make docs` builds a complete site from docs/ that loads nothing from other hosts."""

import shutil
import subprocess
import sys
import tomllib

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
    """The pages of the site that `make docs` builds; `--strict` refuses broken links."""
    root = tmp_path_factory.mktemp("site")
    shutil.copy(SETTINGS, root)
    shutil.copytree(ROOT / "docs", root / "docs")
    build = [sys.executable, "-m", "zensical", "build", "--clean", "--strict"]
    done = subprocess.run(build, cwd=root, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    files = [root / "site" / page.relative_to(DOCS).with_suffix(".html") for page in SITE]
    return {file: HtmlPage(file.read_text("utf-8")) for file in files}


def test_a_page_loads_nothing_from_another_host(site):
    for file, page in site.items():
        loaded = [attributes.get("src", "") for tag in ("script", "img", "iframe") for attributes in page.all(tag)]
        loaded += [attributes.get("href", "") for attributes in page.all("link")]
        assert loaded
        assert not [name for name in loaded if "//" in name], file
