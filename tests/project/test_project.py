"""Files of the project: dependencies, oldest versions, packages."""

import re
import tomllib
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def bounds():
    """Return the lower bound of every requirement, including extras."""
    listed = [*PROJECT["project"]["dependencies"], *chain(*PROJECT["project"]["optional-dependencies"].values())]
    return {re.split(r"[<>=\[]", item)[0].lower(): re.search(r">=([\w.]+)", item)[1] for item in listed}


def test_requirements_of_a_query_have_the_same_bounds():
    listed = {*PROJECT["project"]["dependencies"], *chain(*PROJECT["project"]["optional-dependencies"].values())}
    assert set(PROJECT["dependency-groups"]["query"]) <= listed


def pins(name):
    lines = (ROOT / ".ci" / name).read_text().splitlines()
    return dict(line.lower().split("==") for line in lines if line and not line.startswith("#"))


def test_the_oldest_tested_versions_are_the_lower_bounds():
    lowest = pins("lowest.txt")
    assert set(lowest) == set(bounds())
    for name, bound in bounds().items():
        assert lowest[name].startswith(bound), name


def test_all_requirements_are_pinned_for_the_tests():
    assert set(pins("constraints.txt")) == set(bounds())


def test_only_our_packages_are_installed():
    ours = ["retrieval", "robot", "indexes", "_touch_retrieval"]
    assert PROJECT["tool"]["setuptools"]["packages"]["find"]["include"] == [f"{name}*" for name in ours]
    assert {path.name for path in ROOT.iterdir() if path.is_dir() and (path / "__init__.py").exists()} == {
        *ours,
        "tests",
        "benchmarks",
        "models",
    }


def test_every_folder_with_modules_is_a_package():
    folders = {path.parent for name in ("retrieval", "robot", "indexes") for path in (ROOT / name).rglob("*.py")}
    assert [folder for folder in sorted(folders) if not (folder / "__init__.py").exists()] == []
