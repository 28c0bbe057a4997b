"""Structure of the code: `python -m benchmarks.structure`.

It prints files, lines and imports of every folder. Then it traces some calls through the code: a query's gel images
(with an exported encoder, and with PyTorch), a catalogue's photo into an index, and a grasp's force to the gripper. A
trace lists modules in the order of their first call. "again" counts calls into a module that was entered before.
Modules that everything may use (errors, output, progress) are left out.
"""

import ast
import shutil
import sys
import tempfile
import threading
from collections import Counter
from pathlib import Path
from types import FrameType

ROOT = Path(__file__).parents[1]
PACKAGES = ("indexes", "robot", "retrieval")
EVERYWHERE = ("errors", "output", "progress", "interruption", "version", "__init__")


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def modules() -> dict[str, Path]:
    return {module_name(path): path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}


def imported(path: Path, known: set[str]) -> set[str]:
    """Return modules of the project that a file imports, at its top or inside a function."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= ({f"{node.module}.{alias.name}" for alias in node.names} & known) or {node.module}
    return found & known


def folder_of(path: Path) -> str:
    """Return its package, with the first folder below it."""
    return "/".join(path.relative_to(ROOT).parent.parts[:2])


def folders() -> dict[str, Counter[str]]:
    """Return, for each folder, files, lines, and imports inside it, from others and of others."""
    paths, rows = modules(), {}
    for path in paths.values():
        row = rows.setdefault(folder_of(path), Counter())
        row["files"] += 1
        row["lines"] += len(path.read_text("utf-8").splitlines())
    for name, path in paths.items():
        for other in imported(path, set(paths)) - {name}:
            importer, imported_folder = folder_of(path), folder_of(paths[other])
            rows[importer]["inside" if importer == imported_folder else "of others"] += 1
            if importer != imported_folder:
                rows[imported_folder]["from others"] += 1
    return dict(sorted(rows.items()))


class CallRecorder:
    """Records the modules that are called from another module inside the `with` block, on any thread."""

    def __init__(self) -> None:
        self.entered: list[str] = []
        self._stacks: dict[int, list[str]] = {}

    def __enter__(self) -> "CallRecorder":
        threading.setprofile(self._profile)
        sys.setprofile(self._profile)
        return self

    def __exit__(self, *error: object) -> None:
        sys.setprofile(None)
        threading.setprofile(None)

    def _profile(self, frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        ours = code.co_filename.startswith(tuple(f"{ROOT / package}/" for package in PACKAGES))
        if event not in ("call", "return") or not ours or code.co_name == "<module>":
            return
        stack = self._stacks.setdefault(threading.get_ident(), [])
        if event == "return":
            del stack[-1:]
            return
        name = module_name(Path(code.co_filename))
        if name.rpartition(".")[2] in EVERYWHERE:
            name = stack[-1] if stack else name
        elif not stack or stack[-1] != name:
            self.entered.append(name)
        stack.append(name)

    def lines(self) -> list[str]:
        order = list(dict.fromkeys(self.entered))
        ours = sum(name.startswith("retrieval") for name in order)
        return [
            f"{len(order)} modules ({ours} of retrieval), {len(self.entered) - len(order)} times again:",
            *(f"    {name}" for name in order),
        ]


def follow(folder: Path) -> dict[str, CallRecorder]:
    """Return the traces, with synthetic data in `folder`; one-time set-up is done before."""
    import retrieval
    from retrieval.model.export import export
    from tests import synthetic
    from tests.wsg50_bench import gripper_with_emulator

    drawn = synthetic.make_objects(4, seed=1)
    synthetic.write_catalogue(folder / "catalog", drawn)
    touch = synthetic.write_queries(folder / "drawn", drawn, touches_per_object=1)[drawn[0].object_id][0]
    model = Path(shutil.copy(retrieval.shipped_model(), folder / "model.safetensors"))
    checkpoint = retrieval.load_checkpoint(model)
    names = ("a catalogue's photo", "a query's images, PyTorch", "a query's images, exported", "a grasp's force")
    traces = {name: CallRecorder() for name in names}
    with traces["a catalogue's photo"]:
        retrieval.build_index(folder / "catalog", checkpoint, folder / "index", quiet=True)
    for encoder in ("PyTorch", "exported"):
        if encoder == "exported":
            export(checkpoint)
        with retrieval.open(folder / "index") as searcher:
            searcher.gel_check = None  # the check would reject synthetic pictures
            searcher.query(touch)
            with traces[f"a query's images, {encoder}"]:
                searcher.query(touch)
    with gripper_with_emulator() as (gripper, _), traces["a grasp's force"]:
        gripper.grasp(20.0)
    return traces


def main() -> None:
    print(f"{'folder':24}{'files':>7}{'lines':>8}{'inside':>8}{'of others':>11}{'from others':>13}")
    rows = folders()
    rows["all"] = sum(rows.values(), Counter())
    for name, row in rows.items():
        print(f"{name:24}{row['files']:7}{row['lines']:8}{row['inside']:8}{row['of others']:11}{row['from others']:13}")
    with tempfile.TemporaryDirectory() as folder:
        for name, trace in follow(Path(folder)).items():
            print(f"\n{name}: " + "\n".join(trace.lines()))


if __name__ == "__main__":
    main()
