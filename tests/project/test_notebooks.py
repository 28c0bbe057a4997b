"""The notebooks run from top to bottom on tiny data, and their committed outputs are complete."""

import ast
import json
import re
from importlib import import_module

import pytest

from benchmarks.notebooks import FOLDER, execute, kinds
from retrieval.model.gel_check import CONTACT, GelCheck
from tests import synthetic
from tests.documents import README, blocks

TINY = {
    "comparing_baselines": {"out": "../build/comparing-baselines", "objects": 18, "grasps": 2, "seed": 0, "jobs": 1},
    "error_against_time": {
        "out": "../build/error-against-time",
        "demo": "../demo",
        "photos": 700,
        "queries": 6,
        "repeats": 1,
        "quick": True,
    },
    "one_query": {"demo": "../demo", "out": "../build/one-query", "which": 0, "grasps": 2, "candidates": 4, "top": 2},
    "simulated_data": {
        "out": "../build/simulated-data",
        "seed": 0,
        "index": 2,
        "objects": 1,
        "grasps": 1,
        "gallery": 2,
    },
    "your_own_data": {
        "out": "../build/your-own-data",
        "objects": 8,
        "grasps": 2,
        "seed": 0,
        "jobs": 1,
        "init": "random",
        "top": 2,
    },
}
MAX_OUTPUT_BYTES = 400_000
PACKAGES = ("retrieval", "robot", "indexes")

every_notebook = pytest.mark.parametrize("name", sorted(path.stem for path in FOLDER.glob("*.ipynb")))


def notebook(name):
    return json.loads((FOLDER / f"{name}.ipynb").read_text("utf-8"))


def code_cells(name):
    return [cell for cell in notebook(name)["cells"] if cell["cell_type"] == "code"]


@pytest.fixture
def demo_folder(tmp_path, monkeypatch):
    """A folder next to the notebooks with a recording and a catalogue in the demo's sizes."""
    monkeypatch.setenv("MPLBACKEND", "Agg")
    synthetic.write_recording(tmp_path / "demo" / "recording", synthetic.make_objects(24), 5)
    synthetic.write_catalogue(tmp_path / "demo" / "catalog", synthetic.make_objects(4), photos_per_object=2)
    (tmp_path / "notebooks").mkdir()
    monkeypatch.chdir(tmp_path / "notebooks")


@pytest.mark.slow
@every_notebook
def test_a_notebook_runs_and_its_committed_outputs_have_the_same_kinds(name, demo_folder, monkeypatch):
    # Synthetic pictures replace the demo's touches; the shipped checkpoint would reject them as gel images.
    monkeypatch.setattr(GelCheck, "classify", lambda self, readings, levels=None: [CONTACT] * len(readings))
    tiny = "\n".join(f"{key} = {value!r}" for key, value in TINY[name].items())
    found = [kinds(outputs) for outputs in execute(notebook(name), parameters=tiny)]
    assert found == [kinds(cell["outputs"]) for cell in code_cells(name)]
    assert any("picture" in kind for kind in found)


@every_notebook
def test_the_first_code_cell_contains_only_the_parameters(name):
    first = code_cells(name)[0]
    assert first["metadata"] == {"tags": ["parameters"]}
    found = {}
    for statement in ast.parse("".join(first["source"])).body:
        assert isinstance(statement, ast.Assign)
        found[statement.targets[0].id] = ast.literal_eval(statement.value)
    assert found.keys() == TINY[name].keys()


@every_notebook
def test_committed_outputs_are_small_without_errors_and_without_local_paths(name):
    outputs = [output for cell in code_cells(name) for output in cell["outputs"]]
    assert {output["output_type"] for output in outputs} <= {"stream", "execute_result", "display_data"}
    assert not any(output.get("name") == "stderr" for output in outputs)
    texts = json.dumps([output.get("text", output.get("data", {}).get("text/plain")) for output in outputs])
    assert not re.search(r"(?<![\w.])/(home|root|tmp|work|Users|var|mnt)\b|[A-Z]:\\\\", texts)
    assert (FOLDER / f"{name}.ipynb").stat().st_size < MAX_OUTPUT_BYTES


def test_notebooks_and_the_readme_use_only_public_names_of_the_packages():
    for name in sorted(TINY):
        _require_public(name, *("".join(cell["source"]) for cell in code_cells(name)))
    _require_public("README.md", *blocks("python", README))


def _require_public(where, *sources):
    """Check that sources import only the root packages and use only their public names."""
    for tree in map(ast.parse, sources):
        for node in ast.walk(tree):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            modules += [node.module] if isinstance(node, ast.ImportFrom) else []
            assert not [name for name in modules if name.partition(".")[0] in PACKAGES and "." in name], where
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in PACKAGES:
                assert node.attr in import_module(node.value.id).__all__, f"{where}: {node.value.id}.{node.attr}"
