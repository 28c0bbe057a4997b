"""Registry entries by name: built in, from installed packages, from a user's module; files may name fewer."""

import json
import sys

import pytest

from _touch_retrieval.registry import Registry
from tests import plugins

HERE = "tests.project.test_registry"


class Shape:
    pass


class Square(Shape):
    pass


class Stone:
    pass


ROUND = Shape()


def make(table=None, **options):
    known = {"shape": f"{HERE}:Shape"} if table is None else table
    return Registry("shape", "shapes", known, error=LookupError, **{"base": f"{HERE}:Shape"} | options)


def test_an_installed_package_adds_a_name_and_cannot_replace_ours(tmp_path, monkeypatch):
    added = {"square": f"{HERE}:Square", "shape": f"{HERE}:Stone", "broken": "no_such_package:Thing"}
    plugins.install(tmp_path, monkeypatch, shapes=added)
    registry = make()
    assert registry.names() == ["shape", "broken", "square"]
    assert list(registry) == ["shape"]
    assert (registry.load("square"), registry.load("shape")) == (Square, Shape)
    assert registry.name_of("square") == registry.name_of(Square) == "square"
    with pytest.raises(LookupError, match=r"one of shape, broken, square; got 'blob'.*group touch_retrieval\.shapes"):
        registry.load("blob")
    with pytest.raises(LookupError, match="shape 'broken' cannot be imported: No module named 'no_such_package'"):
        registry.load("broken")


def test_a_user_can_name_any_module_and_a_file_only_an_imported_one(tmp_path, monkeypatch):
    (tmp_path / "shapes_of_mine.py").write_text(f"from {HERE} import Shape\nclass Mine(Shape): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(LookupError, match="a name in a file cannot import it"):
        make().load("shapes_of_mine:Mine")
    assert "shapes_of_mine" not in sys.modules
    assert make().name_of("shapes_of_mine:Mine") == "shapes_of_mine:Mine"
    assert make().load("shapes_of_mine:Mine").__name__ == "Mine"


def test_an_object_has_a_name_that_resolves_to_it():
    registry = make()
    assert registry.name_of(Shape) == "shape"
    assert registry.name_of(Square) == f"{HERE}:Square"
    assert registry.resolve(Square) is registry.resolve(f"{HERE}:Square") is Square
    assert registry.resolve(f"{HERE}:ROUND") is ROUND
    functions = make({}, base=None)
    assert functions.resolve("json:dumps") is json.dumps
    assert functions.name_of(json.dumps) == "json:dumps"
