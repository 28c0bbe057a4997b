"""`retrieve demo`: all steps on the simulated rig, with the commands that a user would type.

The rig collects grasps of objects that the shipped checkpoint was not trained on. The photos of each object's first
grasps make up the catalogue, the touches of its last grasps are the queries. No grasp provides both.
"""

import shlex
import shutil
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from retrieval.commands.build_index import build_index
from retrieval.commands.collect import collect
from retrieval.commands.options import Objects, OptionValues
from retrieval.commands.query import query
from retrieval.commands.serve import serve as serve_index
from retrieval.console.output import say
from retrieval.errors import BadInput

if TYPE_CHECKING:
    from retrieval.data.dataset import Grasp

SEED = 20_000
"""Seed of the demo's objects; the shipped checkpoint was trained on other seeds."""
PHOTOS, TOUCHES = 3, 3
"""Grasps of each object that provide a catalogue photo, and grasps that provide a query touch."""


def demo(
    *,
    out: Annotated[Path, typer.Option(help="folder to write")] = Path("demo"),
    objects: Objects = 20,
    serve: Annotated[bool, typer.Option("--serve", help="then serve the index and its page, until Ctrl-C")] = False,
) -> None:
    """Run all steps on the simulated rig, from collection to query, and write an HTML page."""
    from retrieval.data.dataset import load_grasps

    demo_files = {"recording", "recording-preview.png", "catalog", "index", "index-history", "query.html"}
    if out.exists() and (others := {path.name for path in out.iterdir()} - demo_files):
        raise BadInput(f"{out} must be a new folder or that of an earlier demo, but it contains {sorted(others)[0]}")
    recording, catalogue, index = out / "recording", out / "catalog", out / "index"
    options = {"rig": "sim", "objects": objects, "grasps": PHOTOS + TOUCHES, "seed": SEED, "jobs": 2}
    _run(collect, **options, out=recording, preview=True)
    queries = _split(load_grasps(recording), catalogue)
    in_hand = max(sorted(queries), key=lambda name: len(queries[name]))  # whatever its scores
    _run(build_index, catalogue, out=index)
    gelsight = [OptionValues(map(str, grasp.touches)) for grasp in queries[in_hand]]
    _run(query, gelsight=gelsight, index=str(index), html=out / "query.html", top=8)
    say(
        f"in the hand: {in_hand}. The model was not trained on it. It is the first object of the catalogue with "
        f"{len(gelsight)} query grasps"
    )
    say(f"{TOUCHES} grasps of each object: {_accuracy_summary(index, queries)}")
    say(f"open {out / 'query.html'} and {out / 'recording-preview.png'}")
    if serve:
        _run(serve_index, index=str(index))


def _run(command: Callable[..., object], *arguments: Path, **options: object) -> None:
    """Print a command as a user would type it, and run it."""
    words = [command.__name__.replace("_", "-"), *map(str, arguments)]
    for name, option in options.items():
        for value in option if isinstance(option, list) else [option]:
            words.append(f"--{name.replace('_', '-')}")
            if value is not True:
                words += value if isinstance(value, OptionValues) else [str(value)]
    say("$ retrieve " + shlex.join(words))
    command(*arguments, **options)


def _split(grasps: Sequence["Grasp"], catalogue: Path) -> "dict[str, list[Grasp]]":
    """Copy the photos of each object's first grasps into the catalogue; return the query grasps by object."""
    by_object: dict[str, list[Grasp]] = defaultdict(list)
    for grasp in grasps:
        by_object[grasp.object_id].append(grasp)
    for name, object_grasps in by_object.items():
        (catalogue / name).mkdir(parents=True, exist_ok=True)
        for number, grasp in enumerate(object_grasps[:PHOTOS], start=1):
            shutil.copyfile(grasp.photo, catalogue / name / f"{number}{grasp.photo.suffix}")
    return {name: of_name[PHOTOS : PHOTOS + TOUCHES] for name, of_name in by_object.items() if len(of_name) > PHOTOS}


def _accuracy_summary(index: Path, queries: "dict[str, list[Grasp]]") -> str:
    from retrieval.search.answer import MATCH
    from retrieval.search.searcher import Searcher

    with Searcher.open(index) as searcher:
        gallery = searcher.manifest.objects
        touches = [[grasp.touches for grasp in grasps] for grasps in queries.values()]
        answers = searcher.query_many(touches, top=gallery)
    ranked = [[match.object_id for match in answer.results] for answer in answers]
    # Without contact an answer has no results: such a query gets the rank after all objects.
    ranks = [names.index(name) if name in names else gallery for name, names in zip(queries, ranked, strict=True)]
    matched = [rank for rank, answer in zip(ranks, answers, strict=True) if answer.verdict == MATCH]
    count, first, five = len(ranks), ranks.count(0), sum(rank < 5 for rank in ranks)
    chances = count / gallery, count * min(5, gallery) / gallery
    return (
        f"the true object comes first for {first} of {count} (chance {chances[0]:.1f}), "
        f"among the first five for {five} (chance {chances[1]:.1f}); "
        f'the verdict is "{MATCH}" for {len(matched)}, and {matched.count(0)} of these are right'
    )
