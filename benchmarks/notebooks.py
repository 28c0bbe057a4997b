"""Execute notebooks without Jupyter; store outputs in Jupyter's format, but small and without traces of the machine.

    python -m benchmarks.notebooks                        execute all of notebooks/ and store their outputs
    python -m benchmarks.notebooks one_query.ipynb ...    these only

All of them run right after `make demo`.
"""

import ast
import base64
import contextlib
import io
import json
import os
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from PIL import Image

FOLDER = Path(__file__).parents[1] / "notebooks"
_DPI = 80
_COLOURS = 256

Output = dict[str, Any]


def main(names: list[str]) -> int:
    """Execute notebooks in place and write their outputs into them."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    os.environ["COLUMNS"] = "112"  # width of rich's tables
    os.chdir(FOLDER)
    for path in map(Path, names or sorted(path.name for path in FOLDER.glob("*.ipynb"))):
        print(path, file=sys.stderr)
        document = json.loads(path.read_text("utf-8"))
        cells = [cell for cell in document["cells"] if cell["cell_type"] == "code"]
        for count, (cell, outputs) in enumerate(zip(cells, execute(document), strict=True), start=1):
            cell |= {"execution_count": count, "outputs": outputs}
        path.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", "utf-8")
    return 0


def execute(document: Mapping[str, Any], parameters: str | None = None) -> Iterator[list[Output]]:
    """Run the code cells in order; yield the outputs of each. `parameters` replaces the source of the first one.

    As in Jupyter, the cells run in the module `__main__`, so that their classes can be imported.
    """
    cells = ["".join(cell["source"]) for cell in document["cells"] if cell["cell_type"] == "code"]
    module, program = ModuleType("__main__"), sys.modules["__main__"]
    sys.modules["__main__"] = module
    try:
        for number, source in enumerate(cells):
            try:
                yield _run(source if number or parameters is None else parameters, vars(module))
            except Exception as error:
                error.add_note(f"in code cell {number + 1}:\n{source}")
                raise
    finally:
        sys.modules["__main__"] = program


def kinds(outputs: list[Output]) -> set[str]:
    """Return the kinds of a cell's outputs: "text" printed, a "picture", or a "value" of its last line."""
    found = set()
    for output in outputs:
        pictures = any(mime.startswith("image/") for mime in output.get("data", {}))
        found.add("picture" if pictures else "text" if output["output_type"] == "stream" else "value")
    return found


def _run(source: str, names: dict[str, Any]) -> list[Output]:
    """Run one cell; return its printed text, the value of its last line, and its open figures."""
    tree, value = ast.parse(source), None
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(tree, "<cell>", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), names)
    found: list[Output] = []
    if text := printed.getvalue():
        found.append({"output_type": "stream", "name": "stdout", "text": text.splitlines(keepends=True)})
    if value is not None:
        found.append({"output_type": "execute_result", "execution_count": None, "data": _shown(value), "metadata": {}})
    return found + [{"output_type": "display_data", "data": _picture(one), "metadata": {}} for one in _figures()]


def _shown(value: Any) -> dict[str, Any]:
    if isinstance(value, Image.Image):
        return _picture(value)
    if hasattr(value, "_repr_mimebundle_"):
        return {mime: text.splitlines(keepends=True) for mime, text in value._repr_mimebundle_([], []).items()}
    return {"text/plain": repr(value).splitlines(keepends=True)}


def _figures() -> Iterator[Image.Image]:
    """Yield pyplot's open figures, which Jupyter shows at the end of a cell, and close them."""
    if (pyplot := sys.modules.get("matplotlib.pyplot")) is None:
        return
    for number in pyplot.get_fignums():
        buffer = io.BytesIO()
        pyplot.figure(number).savefig(buffer, format="png", dpi=_DPI)
        pyplot.close(number)
        yield Image.open(buffer)


def _picture(image: Image.Image) -> dict[str, Any]:
    """Return PNG of few colours (for lines) or JPEG (for photographs), whichever is smaller."""
    samples, files = image.convert("RGB"), {}
    for mime, picture, settings in (
        ("image/png", samples.quantize(_COLOURS, dither=Image.Dither.NONE), {"optimize": True}),
        ("image/jpeg", samples, {"quality": 85}),
    ):
        buffer = io.BytesIO()
        picture.save(buffer, mime.removeprefix("image/"), **settings)
        files[mime] = buffer.getvalue()
    mime = min(files, key=lambda name: len(files[name]))
    text = f"<a picture of {image.width} x {image.height} pixels>"
    return {mime: base64.b64encode(files[mime]).decode("ascii"), "text/plain": [text]}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
