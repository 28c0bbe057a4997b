"""Import rules between packages, tested by reading the imports and by running with blocked modules."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tests.documents import CONTRIBUTING, table_rows

ROOT = Path(__file__).parents[2]
PACKAGES = ("indexes", "robot", "retrieval")
SHARED = "_touch_retrieval"
ROWS = table_rows(CONTRIBUTING)
_first = next(number for number, row in enumerate(ROWS) if row[0] == "layers of `retrieval/`") + 2
DOCUMENTED = [tuple(cell.strip("`") for cell in row[0].split(", ")) for row in ROWS[_first:]]
LAYERS = [*DOCUMENTED, ("__main__",)]
"""A module of `retrieval` may import modules of its own layer and of the layers before it."""
MAY_IMPORT_ROBOT = ("retrieval/data/dataset.py", "retrieval/serve/rig.py", "retrieval/commands/")


def modules(package):
    return sorted((ROOT / package).rglob("*.py"))


def imported(path):
    """Return the names of all modules that a file imports, also inside functions."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def packages_of(path):
    return {name.split(".")[0] for name in imported(path)}


def test_a_package_does_not_import_what_it_must_not_know():
    programs = {"tests", "benchmarks", "models", "notebooks"}
    for package, forbidden in {
        "indexes": {"robot", "retrieval", "torch", "cv2", "PIL"},
        "robot": {"indexes", "retrieval", "torch", "faiss"},
        "retrieval": set(),
    }.items():
        for path in modules(package):
            assert not packages_of(path) & (forbidden | programs), path
    for path in modules(SHARED):
        assert packages_of(path) <= {*sys.stdlib_module_names, SHARED, "msgspec"}, path
    for path in modules("retrieval"):
        is_allowed = str(path.relative_to(ROOT)).startswith(MAY_IMPORT_ROBOT)
        assert is_allowed or "robot" not in packages_of(path), path


def test_modules_of_retrieval_import_only_earlier_layers():
    layer_of = {name: number for number, names in enumerate(LAYERS) for name in names}
    for path in modules("retrieval"):
        own = path.relative_to(ROOT / "retrieval").parts[0].removesuffix(".py")
        if own == "__init__":
            continue
        assert own in layer_of, f"{path} has no layer: add it to the table of CONTRIBUTING.md"
        for name in imported(path):
            package, _, inner = name.partition(".")
            layer = layer_of.get(inner.partition(".")[0]) if package == "retrieval" else None
            assert layer is None or layer <= layer_of[own], f"{path} imports {name}"


@pytest.mark.parametrize("package", PACKAGES)
def test_no_modules_import_each_other_in_a_circle(package):
    """Neither between rooms nor inside one; imports inside functions count, those of the package's public names not."""
    names = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for path in modules(package)
    }
    imports = {name: (imported(path) & names.keys()) - {name, package} for name, path in names.items()}
    TopologicalSorter(imports).prepare()  # raises CycleError, which contains the circle


def run_blocked(code, blocked):
    """Run code in a process in which imports of blocked modules fail."""
    guard = (
        "import sys\n"
        "class Guard:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.split('.')[0] in {set(blocked)!r}: raise ImportError('blocked: ' + name)\n"
        "sys.meta_path.insert(0, Guard())\n"
    )
    return subprocess.run(
        [sys.executable, "-c", guard + code], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )


SERVE = ("fastapi", "starlette", "uvicorn", "pydantic", "httpx")
HEAVY = ("torch", "faiss", "cv2", "sklearn", "matplotlib", "numpy", "PIL", "scipy", "rich", "jinja2", *SERVE)


DEVICE_PACKAGES = ("websockets", "pyrealsense2", "roslibpy", "trimesh", "torch", "faiss")
OF_ROBOT = [
    str(path.relative_to(ROOT).with_suffix("")).replace("/", ".").removesuffix(".__init__") for path in modules("robot")
]


@pytest.mark.parametrize(
    ("imports", "blocked"),
    [
        (["robot, robot.recording.folder"], ("numba", "cv2", *DEVICE_PACKAGES)),
        (OF_ROBOT, DEVICE_PACKAGES),
        (["retrieval.serve.rig", *(name for name in OF_ROBOT if "robot.sim" not in name)], ("numba",)),
        (["indexes.store.folder", "indexes.kinds.measure"], ("torch", "faiss", "cv2", "PIL", "scipy", "sklearn")),
    ],
    ids=["robot without extras", "all of robot without device packages", "real rigs without numba", "indexes"],
)
def test_packages_can_be_imported_without_what_they_do_not_need(imports, blocked):
    done = run_blocked(f"import {', '.join(imports)}", blocked)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("role", "table", "message"),
    [
        ("camera", {"driver": "realsense"}, "pip install 'touch-retrieval[realsense]'"),
    ],
)
def test_a_driver_without_its_package_prints_how_to_install_it(role, table, message):
    code = f"""
import numpy as np
from robot.errors import DeviceError
from robot.real_rig import load_driver
from robot.readings import Region
options = {{"workspace": Region((-1, -1, 0), (1, 1, 1)), "extrinsics": np.eye(4)}}
device = load_driver({role!r}, {table!r}, "table", **options)
try:
    device.connect()
except DeviceError as error:
    print(error)
"""
    done = run_blocked(code, DEVICE_PACKAGES)
    assert message in done.stdout, done.stderr
    assert "missing" in done.stdout


def test_the_simulated_rig_without_numba_prints_in_one_line_what_to_install(tmp_path):
    code = f"import os, sys; os.chdir({str(tmp_path)!r}); sys.path.insert(0, {str(ROOT)!r})\n"
    code += "from retrieval.commands.main import main; sys.exit(main(['collect', '--out', 'grasps']))"
    done = run_blocked(code, ("numba",))
    assert done.returncode == 2, done.stderr
    assert done.stderr.strip().splitlines()[-1].endswith("run pip install 'touch-retrieval[sim]'")
    assert "Traceback" not in done.stderr


def test_help_imports_no_large_packages_and_a_command_no_other_command():
    code = """
import contextlib, io, sys
from retrieval.commands.main import COMMANDS, main
with contextlib.redirect_stdout(io.StringIO()):
    main(["--debug", "query", "--help"])
imported = {name for name in sys.modules if name.startswith("retrieval.commands.")}
assert imported == {f"retrieval.commands.{name}" for name in ("main", "options", "query")}, imported
for words in ([], *([name] for name in COMMANDS), ["rig", "check"], ["rig", "calibrate"]):
    with contextlib.redirect_stdout(io.StringIO()) as output:
        code = main([*words, "--help"])
    assert code == 0 and "Usage: retrieve" in output.getvalue(), words
"""
    done = run_blocked(code, HEAVY)
    assert done.returncode == 0, done.stderr
