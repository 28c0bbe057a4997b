"""Public names: imports are fast, examples run, and the reference page is up to date."""

import dataclasses
import doctest
import inspect
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import robot
from benchmarks import reference
from benchmarks.reference import PACKAGES, PAGE
from retrieval.indexing.build import build_index
from retrieval.model.checkpoint import load_checkpoint, store_checkpoint
from tests import synthetic
from tests.project.test_imports import HEAVY, run_blocked
from tests.reference_model import REFERENCE_CALIBRATION


@pytest.fixture(scope="module")
def folder(catalogue, touch, model, tmp_path_factory):
    """The files that the examples name, for two objects. The examples write to this folder."""
    root = tmp_path_factory.mktemp("examples")
    objects = synthetic.make_objects(2, seed=9)
    photos = sorted(catalogue.rglob("*.jpg"))
    for name, of_object in (("mug", photos[:2]), ("tin", photos[3:5])):
        (root / "catalog" / name).mkdir(parents=True)
        for number, photo in enumerate(of_object, start=1):
            shutil.copy(photo, root / "catalog" / name / f"{number}.jpg")
    for number, grasp in enumerate(synthetic.write_queries(root / "drawn", objects[:1], 2)[objects[0].object_id]):
        for finger, path in zip("ab", grasp, strict=True):
            shutil.copy(path, root / f"{finger}{'' if number == 0 else 2}.png")
    with robot.RecordingWriter(root / "recording", {"source": "drawn", "sensor": "none"}) as writer:
        for number, name in enumerate(("mug", "mug", "tin", "tin")):
            images = {"photo": root / "catalog" / name / "1.jpg", "touch_a": root / "a.png", "touch_b": root / "b.png"}
            writer.append(f"{number:06d}", name, images)
    synthetic.write_recording(root / "lab", synthetic.make_objects(12), 2, before=False)
    calibrated = dataclasses.replace(load_checkpoint(model), references=REFERENCE_CALIBRATION)
    store_checkpoint(calibrated, root / "model.safetensors")
    build_index(root / "catalog", load_checkpoint(root / "model.safetensors"), root / "index")
    return root


def test_every_public_name_has_an_example_that_runs(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    named = [(package.__name__, package) for package in PACKAGES]
    named += [(f"{each.__name__}.{name}", getattr(each, name)) for each in PACKAGES for name in each.__all__]
    for name, thing in named:
        if not callable(thing) and thing not in PACKAGES:
            continue
        known = {package.__name__: package for package in PACKAGES}
        found = doctest.DocTestParser().get_doctest(inspect.getdoc(thing), known, name, None, None)
        assert found.examples, f"{name} has no example"
        runner.run(found, clear_globs=True)
    assert runner.summarize(verbose=False).failed == 0, capsys.readouterr().out


def test_the_reference_page_is_up_to_date():
    assert PAGE.read_text("utf-8") == reference.reference(), "run `python -m benchmarks.reference`"


def test_importing_the_packages_and_listing_their_names_imports_no_large_packages():
    code = "import retrieval, robot, indexes\nprint(dir(retrieval), dir(robot), dir(indexes), indexes.load_kind)"
    done = run_blocked(code, HEAVY)
    assert done.returncode == 0, done.stderr
    for name in ("open", "encode_photos", "read_recording", "IndexStore", "__getattr__"):
        assert f"'{name}'" in done.stdout


@pytest.mark.parametrize("package", PACKAGES)
def test_all_lists_every_public_name_and_none_is_a_module_of_its_package(package):
    """`import robot.collection` would replace a public name `collection` by the module."""
    assert set(package.__all__) <= set(dir(package))
    with pytest.raises(AttributeError, match=f"module '{package.__name__}' has no attribute 'absent'"):
        _ = package.absent
    assert not {path.stem for path in Path(package.__file__).parent.iterdir()} & set(package.__all__)


@pytest.mark.slow
def test_type_checkers_find_the_public_names_and_no_others(tmp_path):
    lines = [f"import {package.__name__}" for package in PACKAGES]
    lines += [f"reveal_type({package.__name__}.{name})" for package in PACKAGES for name in package.__all__]
    program = tmp_path / "program.py"
    program.write_text("\n".join([*lines, "retrieval.absent"]))
    command = [sys.executable, "-m", "mypy", "--config-file", str(PAGE.parents[1] / "pyproject.toml"), str(program)]
    done = subprocess.run(command, cwd=PAGE.parents[1], capture_output=True, text=True, timeout=600, check=False)
    assert 'Module has no attribute "absent"' in done.stdout, done.stdout + done.stderr
    assert done.stdout.count("Revealed type") == sum(len(package.__all__) for package in PACKAGES)
    assert 'Revealed type is "Any"' not in done.stdout
