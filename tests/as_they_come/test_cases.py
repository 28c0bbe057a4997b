"""Each case of this folder: read correctly, or refused with what is wrong; never a wrong answer without a word."""

import importlib
import shutil
from pathlib import Path

import pytest

CASES = sorted(path.parent for path in Path(__file__).parent.glob("*/case.py"))
pytest.register_assert_rewrite(*(f"tests.as_they_come.{case.name}.case" for case in CASES))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_input_as_people_have_it(case, tmp_path, request):
    folder = shutil.copytree(case, tmp_path / "input", ignore=shutil.ignore_patterns("case.py", "__pycache__"))
    importlib.import_module(f"tests.as_they_come.{case.name}.case").check(folder, request.getfixturevalue)
