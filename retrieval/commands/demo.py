"""`retrieve demo`: the whole job on the simulated rig, with the commands that a user would type.

The rig collects grasps of objects that the shipped checkpoint never saw. The photos of each object's first grasps
make the catalogue, the touches of its last ones are the queries; no grasp gives both.
"""

import os
import shutil
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from retrieval.commands import cli
from retrieval.console.output import say
from retrieval.data.dataset import Grasp, load_grasps
from retrieval.errors import BadInput, RetrievalError
from retrieval.search.answer import EXIT_CODES, MATCH

SEED = 20_000
"""Of the demo's objects; the shipped checkpoint was trained on other seeds."""
PHOTOS, TOUCHES = 3, 3
"""Grasps of each object that give a photo to the catalogue, and those that give a touch."""


def run_demo(folder: Path, objects: int = 20, jobs: int = 2) -> None:
    """Collect, build the index, query; ends with a table and `folder`/query.html. What is there is used again.

    Raises BadInput for a folder of other files, and it or RetrievalError where a command fails, by its exit code.
    """
    _check_folder(folder)
    with _own_state(folder / "state"):
        recording, catalogue, index = folder / "recording", folder / "catalog", folder / "index"
        _retrieve(
            *("collect", "--rig", "sim", "--objects", objects, "--grasps", PHOTOS + TOUCHES),
            *("--seed", SEED, "--jobs", jobs, "--out", recording, "--preview"),
        )
        queries = _split(load_grasps(recording), catalogue)
        in_hand = sorted(queries)[len(queries) // 2]
        _retrieve("build-index", catalogue, "--out", index)
        gelsight = [word for grasp in queries[in_hand] for word in ("--gelsight", *grasp.touches)]
        _retrieve("query", *gelsight, "--index", index, "--html", folder / "query.html", "--top", 8)
        say(f"in the hand: {in_hand}, an object that the model was never trained on")
        say(f"{TOUCHES} grasps of each object: {_first_places(index, queries)}")
        say(f"look at {folder / 'query.html'} and {folder / 'recording-preview.png'}")


def _check_folder(folder: Path) -> None:
    ours = {"recording", "recording-preview.png", "catalog", "index", "state", "query.html"}
    if folder.exists() and (others := {path.name for path in folder.iterdir()} - ours):
        raise BadInput(f"{folder} must be a new folder or an earlier demo's; it holds {sorted(others)[0]}")


@contextmanager
def _own_state(folder: Path) -> Iterator[None]:
    """The demo's model and index do not become the defaults of the user's own commands."""
    before = os.environ.get("XDG_STATE_HOME")
    os.environ["XDG_STATE_HOME"] = str(folder)
    try:
        yield
    finally:
        if before is None:
            del os.environ["XDG_STATE_HOME"]
        else:
            os.environ["XDG_STATE_HOME"] = before


def _split(grasps: Sequence[Grasp], catalogue: Path) -> dict[str, list[Grasp]]:
    """Copy the photos of each object's first grasps into the catalogue; returns its last grasps, by object."""
    by_object: dict[str, list[Grasp]] = defaultdict(list)
    for grasp in grasps:
        by_object[grasp.object_id].append(grasp)
    for name, own in by_object.items():
        (catalogue / name).mkdir(parents=True, exist_ok=True)
        for number, grasp in enumerate(own[:PHOTOS], start=1):
            shutil.copyfile(grasp.photo, catalogue / name / f"{number}{grasp.photo.suffix}")
    return {name: own[PHOTOS : PHOTOS + TOUCHES] for name, own in by_object.items() if len(own) > PHOTOS}


def _first_places(index: Path, queries: dict[str, list[Grasp]]) -> str:
    """How often the true object comes first, and among the first five; and what the verdicts were worth."""
    from retrieval.search.searcher import Searcher

    with Searcher.open(index) as searcher:
        gallery = searcher.objects.count
        touches = [[grasp.touches for grasp in grasps] for grasps in queries.values()]
        answers = searcher.query_many(touches, top=gallery)
    ranked = [[match.object_id for match in answer.results] for answer in answers]
    # An object that was not felt is not found.
    places = [names.index(name) if name in names else gallery for name, names in zip(queries, ranked, strict=True)]
    matched = [place for place, answer in zip(places, answers, strict=True) if answer.verdict == MATCH]
    count, first, five = len(places), places.count(0), sum(place < 5 for place in places)
    chances = count / gallery, count * min(5, gallery) / gallery
    return (
        f"the true object comes first for {first} of {count} (chance {chances[0]:.1f}), "
        f"among the first five for {five} (chance {chances[1]:.1f}); "
        f'the verdict is "{MATCH}" for {len(matched)}, of which {matched.count(0)} are right'
    )


def _retrieve(*arguments: object) -> None:
    """Say a command as a user would type it, and run it."""
    words = [str(argument) for argument in arguments]
    say("$ retrieve " + " ".join(words))
    code = cli.main(words)
    if code not in EXIT_CODES.values():  # "none of these" is an answer too
        failure = BadInput if code == BadInput.exit_code else RetrievalError
        raise failure(f"`retrieve {words[0]}` failed; what it said stands above")
