"""Write docs/reference.md, docs/commands.md and docs/datasets.md: `python -m benchmarks.reference`.

The pages come from the docstrings of the public names, from the commands' help, and from the importers.
"""

import argparse
import ast
import dataclasses
import inspect
import itertools
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer
from typer.testing import CliRunner

import indexes
import retrieval
import robot
from retrieval.commands.main import application
from robot.importers import IMPORTERS, data_set_of, load_importer, options_of, title_of

PACKAGES = (retrieval, robot, indexes)
PAGE = Path(__file__).parents[1] / "docs" / "reference.md"
COMMANDS = PAGE.with_name("commands.md")
DATA_SETS = PAGE.with_name("datasets.md")
MADE_BY_HAND = (
    retrieval.Client,
    retrieval.MethodSettings,
    robot.Frame,
    robot.Grip,
    robot.Pose,
    robot.RecordingWriter,
    robot.Scene,
    indexes.IndexStore,
)
"""Classes that a user creates directly; functions return all others."""
HEAD = """# Reference

The public names of the three packages, from their docstrings; `python -m benchmarks.reference` writes this page. The
tests run every example in a folder that contains `catalog/`, `index/`, `recording/`, `lab/` (a recording of 12
objects), `model.safetensors` and the gel images of two grasps, `a.png`, `b.png`, `a2.png`, `b2.png`. A name is
imported on first use, so `import retrieval` alone is fast.
"""
WIDTH = 98
"""Width of help texts in a terminal of 100 columns."""
COMMANDS_HEAD = """# Commands

Exit codes: 0 done, 1 the job ran and failed, 2 wrong use or bad input; `query` adds 3 to 5 for its
[verdicts](answers.md). With `--json`, stdout contains one JSON document, and all other output goes to stderr.
`python -m benchmarks.reference` writes this page from each command's `--help`.
"""


DATA_SETS_HEAD = """# Data sets

```sh
retrieve import                                             # list the importers and their options
retrieve import billets billets/ --out billets-recording/
retrieve import folder pictures/ --out my-recording/ --option sensor="GelSight Mini" touch='{object}/touch_{n}'
retrieve import rosbag bags/ --out lab-recording/ --option touch_a=/gel/a touch_b=/gel/b photo=/camera/color
retrieve check recording/                                   # before training
```

An importer reads a public data set in its published layout, or your own pictures, and writes a
[recording](formats.md#recording). Some need packages: `pip install 'touch-retrieval[importers]'`. An interrupted import
continues when you run it again, and new files are added; with other options, or if a file changed or is gone, it is
refused: give another `--out`. Unreadable items, and first images of a video that are black, dim or in another colour,
are left out and counted (`skipped` of `recording.json`, which also has licence, citation and the data set's own
information on objects). A published split by objects is in `splits/<name>.json`, for `--split`.

The data sets are not ours, and their licences bind you. "Not stated" means that we know of no licence: look at the
page of the data set, ask its authors, and write the answer into `recording.json`
([licences](training.md#licences)). If parts of a layout are not verified, the importer follows the authors'
descriptions and other people's readers. [Real data](real.md#what-counts-as-touch) defines the controls of the notes.

"""
OTHER_DATA_SETS = """
## Data that a laboratory can get now

**Not run**: we could not download these. The facts are from their pages, read in November 2026.

* **TactileMimic** ([card](https://huggingface.co/datasets/b1o1o1m/TactileMimic); it asks you to accept conditions): two
  GelSight Minis on a parallel gripper and a camera on the wrist, like the rig of the paper; 26 objects, 369 episodes.
  Its files are zarr stores: write a [plug-in](extending.md) that yields the images of each episode. A photo has light
  and pose in common with the touch of its episode, so the photos of a catalogue must come from other episodes.
* **RCT** (arXiv 2606.31694; 9.2 GB on figshare): three DIGITs pressed on 122 flat materials, 1,832 presses, a photo of
  each material. [`folder`](#other-data-sets) reads it.
* **The Feeling of Success**
  ([files](https://opara.zih.tu-dresden.de/items/d5c56810-fc26-4b53-8201-acb75ff055ac); older links are dead): the data
  set of the paper's kind; [some of its 38 files](#feeling-of-success) are enough.

## Other data sets

[`folder`](#folder) reads these layouts, with the options that the table lists. For other layouts [write a
plug-in](extending.md).

| data set | options of `retrieve import folder` |
| --- | --- |
| SSVTP | `touch=images_tac/image_{object}_tac photo=images_rgb/image_{object}_rgb`; each pair is an object |
| TVL, part HCT | `touch={data}/{object}/tactile/{frame} photo={data}/{object}/vision/{frame}` |
| RCT | `touch=tactile/{object}/{position}/{sensor}/{frame} photo=rgb/{object}`, with the names of its folders |
| X-Capture | `touch={object}/{point}/*_tactile photo={object}/{point}/*_rgb` |
| YCB-Slide | `touch=real/{object}/{log}/frames/{n}00 photo=real/{object}/{log}/webcam_frames/{n}00` |
| HapticMatch | none, write a [plug-in](extending.md): the height maps are pickled |
| VisGel | none, write a [plug-in](extending.md): it must choose a frame of each recording |
"""


def reference() -> str:
    """Return docs/reference.md."""
    page = HEAD + "".join(_package(package) for package in PACKAGES)
    return re.sub(r"\n{3,}", "\n\n", page)


def _package(package: Any) -> str:
    parts = [f"\n## {package.__name__}\n", _text(inspect.getdoc(package))]
    parts += [_public(package, name) for name in package.__all__]
    return "\n".join(parts)


def _public(package: Any, name: str) -> str:
    thing, title = getattr(package, name), f"{package.__name__}.{name}"
    if not callable(thing):
        return f"\n### {title}\n\n{_text(_below(package, name))}"
    parts = [_heading("###", title, thing), _text(inspect.getdoc(thing))]
    if inspect.isclass(thing):
        parts.append(_fields(thing))
        parts += [_member(name, own, member) for own, member in vars(thing).items() if not own.startswith("_")]
    return "\n".join(filter(None, parts))


def _member(of: str, name: str, member: Any) -> str:
    """Return a method or property of a class; nothing if it has no text or is itself a public name."""
    function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
    if not inspect.isfunction(function) or not function.__doc__ or getattr(retrieval.open, "__func__", 0) is function:
        return ""
    return "\n".join([_heading("####", f"{of}.{name}", member), _text(inspect.getdoc(function))])


def _heading(level: str, title: str, thing: Any) -> str:
    """Return the name, and below it a call with names and defaults of the arguments, without types.

    Properties, and classes that users do not create, have no call.
    """
    if isinstance(thing, property) or (inspect.isclass(thing) and thing not in MADE_BY_HAND):
        return f"\n{level} {title}\n"
    signature = inspect.signature(getattr(thing, "__func__", thing))
    named = [item for item in signature.parameters.values() if item.name not in ("self", "cls")]
    bare = [item.replace(annotation=item.empty) for item in named]
    text = str(signature.replace(parameters=bare, return_annotation=signature.empty))
    arguments = re.sub(r"<built-in function (\w+)>", r"\1", text).replace("'", '"')
    if arguments == "()":
        return f"\n{level} {title}()\n"
    return f"\n{level} {title}\n\n```python\n{title}{arguments}\n```\n"


def _fields(thing: type) -> str:
    names = getattr(thing, "_fields", None) or [
        field.name for field in (dataclasses.fields(thing) if dataclasses.is_dataclass(thing) else ())
    ]
    return f"\nFields: {', '.join(f'`{name}`' for name in names)}.\n" if names else ""


def _below(package: Any, name: str) -> str:
    """Return the text below a constant."""
    body = ast.parse(Path(package.__file__).read_text("utf-8")).body
    for statement, after in itertools.pairwise(body):
        targets = getattr(statement, "targets", None) or [getattr(statement, "target", None)]
        if targets[0] is not None and ast.unparse(targets[0]) == name:
            assert isinstance(after, ast.Expr)
            assert isinstance(after.value, ast.Constant)
            return inspect.cleandoc(str(after.value.value))
    raise AssertionError(f"{name} has no text below it")


def _text(docstring: str | None) -> str:
    """Convert a docstring to Markdown; examples and text in columns become blocks."""
    assert docstring, "every public name has a docstring"
    return "\n\n".join(_paragraph(part) for part in re.split(r"\n\n+", docstring.strip())) + "\n"


def _paragraph(text: str) -> str:
    if text.startswith(">>>"):
        return f"```python\n{text}\n```"
    if section := re.match(r"(Args|Attributes|Raises|Returns):\n", text):  # of a Google-style docstring
        below = textwrap.dedent(text[section.end() :])
        if section[1] == "Returns":
            return f"Returns: {below}"
        entries = re.split(r"\n(?=\S)", below)
        items = [re.sub(r"^(\w+): ", r"`\1`: ", entry).replace("\n    ", "\n  ") for entry in entries]
        return f"{section[1]}:\n\n" + "\n".join(f"* {item}" for item in items)
    columns = re.search(r"^\S.*\S {2,}\S", text, flags=re.MULTILINE) and not text.startswith("* ")
    return f"```\n{text}\n```" if columns else text


def commands() -> str:
    """Return docs/commands.md."""
    return COMMANDS_HEAD + "".join(_help("retrieve", typer.main.get_command(application())))


def _help(title: str, command: Any) -> Iterator[str]:
    """Yield the help of a command and of its subcommands."""
    words = [*title.split()[1:], "--help"]
    result = CliRunner().invoke(application(), words, prog_name="retrieve", terminal_width=WIDTH)
    yield f"\n## {title}\n\n```\n{result.stdout.strip()}\n```\n"
    for name, below in getattr(command, "commands", {}).items():
        yield from _help(f"{title} {name}", below)


def data_sets() -> str:
    """Return docs/datasets.md."""
    columns = ("name", "the folder must contain", "sensor", "fingers", "no-contact frame", "licence", "layout")
    rows = [columns, ("---",) * len(columns)]
    for name in sorted(IMPORTERS):
        facts = data_set_of(name)
        verified = "parts are not verified" if facts.unverified else "verified on the data"
        frame = facts.background if facts.background != "none" else ""
        fingers = str(facts.fingers or "any")
        licence = f"{facts.licence}: {facts.terms}" if facts.terms else facts.licence
        rows.append((f"[`{name}`](#{name})", facts.expects, facts.sensor, fingers, frame, licence, verified))
    table = "".join(f"| {' | '.join(row)} |\n" for row in rows)
    return DATA_SETS_HEAD + table + "".join(map(_data_set, sorted(IMPORTERS))) + OTHER_DATA_SETS


def _data_set(name: str) -> str:
    facts, options = data_set_of(name), options_of(load_importer(name))
    below = inspect.cleandoc(sys.modules[load_importer(name).__module__].__doc__ or "").partition("\n")[2]
    parts = [f"\n## {name}\n", f"{title_of(name)}. Citation: {facts.citation}.\n", below.strip("\n") + "\n"]
    if options:
        parts.append(f"Options: {', '.join(f'`{option}={default}`' for option, (_, default) in options.items())}.\n")
    parts += [f"* {note[0].upper()}{note[1:].rstrip('.')}." for note in facts.notes()]
    return "\n".join(parts).rstrip() + "\n"


def main(arguments: list[str]) -> None:
    """Write the pages."""
    argparse.ArgumentParser(prog="python -m benchmarks.reference", description=__doc__).parse_args(arguments)
    PAGE.parent.mkdir(exist_ok=True)
    for page, text in ((PAGE, reference()), (COMMANDS, commands()), (DATA_SETS, data_sets())):
        page.write_text(text, "utf-8")
        print(page)


if __name__ == "__main__":
    main(sys.argv[1:])
