"""Two shops below one folder, and a second catalogue built into the index of a first, are warned of by name."""

import shutil

from retrieval.data.naming import Naming, naming_warnings
from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint


def warnings_of(*paths):
    return naming_warnings([(path.split("/")[0], path) for path in paths], Naming())


def check(folder, get):
    (warning,) = warnings_of("ikea/mug/1.jpg", "ikea/cup/1.jpg", "ikea/tin/1.jpg", "lidl/pan/1.jpg", "lidl/pot/2.jpg")
    assert "ikea, lidl: photos in 5 folders" in warning
    assert "--objects-from" in warning
    views = [f"{name}/{view}/1.jpg" for name in ("mug", "cup") for view in ("front", "back")]
    assert warnings_of(*views) == []

    first, model = get("catalogue"), load_checkpoint(get("model"))
    second = shutil.copytree(first, folder / "second", ignore=lambda place, names: sorted(names)[:1])
    assert build_index(first, model, folder / "index").warnings == []
    (warning,) = build_index(second, model, folder / "index").warnings
    assert str(first) in warning
    assert "--out" in warning
    moved = second.rename(folder / "moved")  # the same catalogue at another place
    assert build_index(moved, model, folder / "index").warnings == []
