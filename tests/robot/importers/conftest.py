"""The miniature of the data set that a test module is about."""

from importlib import import_module

import pytest


@pytest.fixture(autouse=True)
def _quick(no_fsync):
    """The tests write many small files."""


@pytest.fixture
def source(request, tmp_path):
    name = request.module.__name__.rpartition("test_")[2]
    import_module(f"tests.miniatures.{name}").write(tmp_path / "src")
    return tmp_path / "src"
