"""Files of the project: dependencies, oldest versions, packages."""

import re
import tomllib
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


LISTED = [*PROJECT["project"]["dependencies"], *chain(*PROJECT["project"]["optional-dependencies"].values())]
BOUNDS = {re.split(r"[<>=\[]", item)[0].lower(): re.search(r">=([\w.]+)", item)[1] for item in LISTED}


def pins(name):
    lines = (ROOT / ".ci" / name).read_text().splitlines()
    return dict(line.lower().split("==") for line in lines if line and not line.startswith("#"))


def test_all_requirements_are_pinned_and_the_oldest_tested_versions_are_the_lower_bounds():
    lowest = pins("lowest.txt")
    assert set(lowest) == set(pins("constraints.txt")) == set(BOUNDS)
    for name, bound in BOUNDS.items():
        assert lowest[name].startswith(bound), name


def test_only_our_packages_are_installed_and_all_their_folders_are_packages():
    ours = ["retrieval", "robot", "indexes", "_touch_retrieval"]
    assert PROJECT["tool"]["setuptools"]["packages"]["find"]["include"] == [f"{name}*" for name in ours]
    assert {path.name for path in ROOT.iterdir() if path.is_dir() and (path / "__init__.py").exists()} == {
        *ours,
        "tests",
        "benchmarks",
        "models",
    }
    folders = {path.parent for name in ours for path in (ROOT / name).rglob("*.py")}
    assert not [folder for folder in folders if not (folder / "__init__.py").exists()]
