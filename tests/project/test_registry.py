"""Registry entries by name: built in, from installed packages, from a user's module; files may name fewer."""

import json
import re
import sys

import pytest

from _touch_retrieval.registry import Registry
from tests import plugins

HERE = "tests.project.test_registry"


class Shape:
    class Inner:
        pass


class Square(Shape):
    pass


class Stone:
    pass


ROUND = Shape()


def make(table=None, **options):
    known = {"shape": f"{HERE}:Shape"} if table is None else table
    return Registry("shape", "shapes", known, error=LookupError, **{"base": f"{HERE}:Shape"} | options)


def test_a_built_in_name_is_imported_when_it_is_loaded():
    registry = make({"decoder": "json.decoder:JSONDecoder", "absent": "no.such.module:Thing"}, base=None)
    assert list(registry) == ["decoder", "absent"]
    assert registry.load("decoder") is json.decoder.JSONDecoder


def test_an_unknown_name_lists_the_known_ones_and_how_to_add_one(tmp_path, monkeypatch):
    plugins.install(tmp_path, monkeypatch, shapes={"square": f"{HERE}:Square"})
    words = (
        "shape must be one of shape, square; got 'blob'. Give module:Class for your own, or install a package that "
        "adds one by an entry point of the group touch_retrieval.shapes"
    )
    for find in (make().load, make().name_of):
        with pytest.raises(LookupError, match=re.escape(words)):
            find("blob")


def test_an_installed_package_adds_a_name_and_cannot_replace_ours(tmp_path, monkeypatch):
    plugins.install(tmp_path, monkeypatch, shapes={"square": f"{HERE}:Square", "shape": f"{HERE}:Stone"})
    registry = make()
    assert registry.names() == ["shape", "square"]
    assert list(registry) == ["shape"]
    assert (registry.load("square"), registry.load("shape")) == (Square, Shape)
    assert registry.name_of("square") == "square"


def test_a_user_can_name_any_module_and_a_file_only_an_imported_one(tmp_path, monkeypatch):
    (tmp_path / "shapes_of_mine.py").write_text(f"from {HERE} import Shape\nclass Mine(Shape): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(LookupError, match="its module is not imported, and a name in a file cannot import it"):
        make().load("shapes_of_mine:Mine")
    assert "shapes_of_mine" not in sys.modules
    assert make().name_of("shapes_of_mine:Mine") == "shapes_of_mine:Mine"
    assert make().load("shapes_of_mine:Mine").__name__ == "Mine"


def test_an_object_has_a_name_that_resolves_to_it(tmp_path, monkeypatch):
    registry = make()
    assert registry.name_of(Shape) == "shape"
    assert registry.name_of(Square) == f"{HERE}:Square"
    assert registry.resolve(Square) is registry.resolve(f"{HERE}:Square") is Square
    plugins.install(tmp_path, monkeypatch, shapes={"square": f"{HERE}:Square"})
    assert registry.name_of(Square) == "square"


def test_a_class_in_a_function_has_no_name():
    class Hidden(Shape):
        pass

    with pytest.raises(LookupError, match="must be defined at the top level of its module"):
        make().name_of(Hidden)


@pytest.mark.parametrize("place", [f"{HERE}:Stone", "json:dumps", f"{HERE}:__doc__"])
def test_an_object_of_another_type_is_refused(place):
    with pytest.raises(LookupError, match=f"shape {place!r} must be a Shape; got "):
        make().name_of(place)
    with pytest.raises(LookupError, match="must be a Shape"):
        make().name_of(Stone)


def test_an_instance_is_accepted():
    assert make().resolve(f"{HERE}:ROUND") is ROUND


@pytest.mark.parametrize("place", ["no_such_package:Thing", f"{HERE}:Thing", f"{HERE}:"])
def test_a_failed_import_is_one_clear_error(place):
    with pytest.raises(LookupError, match=r"cannot be imported|must be one of shape"):
        make().name_of(place)


def test_a_registry_without_a_base_contains_functions():
    registry = make({}, base=None)
    assert registry.resolve("json:dumps") is json.dumps
    assert registry.name_of(json.dumps) == "json:dumps"
    with pytest.raises(LookupError, match="must be a function"):
        registry.resolve("json:__version__" if hasattr(json, "__version__") else f"{HERE}:HERE")
