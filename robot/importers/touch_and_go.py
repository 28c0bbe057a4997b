"""Touch and Go: GelSight videos of people who touch things indoors and outdoors, with egocentric videos.

    label.txt                                     a line per frame in contact: "20220601_182052/0000033833.jpg,3"
    category_reference.txt                        "Name: id"
    dataset/<sequence>/{video_frame,gelsight_frame}/<frame>.jpg     the same name is the same moment
    train.txt, test.txt                           published splits, of the authors' code; lines as in label.txt

The authors' extract_frame.py extracts the frames from the videos.
The data set names materials, not objects. An unbroken run of frames in contact with one material counts as one object,
`<sequence>-<first frame>`, and `frames` evenly spread frames of it are its grasps (0: all). A video is a sequence: a
split must not separate its runs. The no-contact frame of a video is the first frame that label.txt does not list.
"""

import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from robot.errors import ImporterError
from robot.importers.importing import (
    NOT_STATED,
    DataSet,
    DataSetMetadata,
    Images,
    Item,
    Progress,
    Skip,
    import_items,
    safe_name,
)
from robot.importers.row_splits import RowSplit, Split
from robot.recording.folder import Recording, SharedImage

DATA_SET = DataSet(
    source="touch-and-go.github.io",
    licence=NOT_STATED,
    terms="the authors' repository states none; see touch-and-go.github.io",
    citation="Yang, Ma, Zhang, Zhu, Yuan, Owens, Touch and Go: Learning from Human-Collected Vision and Touch, NeurIPS "
    "2022 Datasets and Benchmarks",
    sensor="GelSight",
    rig="by hand, camera on the head",
    expects="`label.txt` and `dataset/<sequence>/{video_frame,gelsight_frame}/<frame>.jpg`",
    background="one frame per video",
    caveats=(
        "An object is a run of frames in contact with one material: a surrogate, because the data set names no "
        "instances. Two runs of a video may touch one thing, so split by sequence_id.",
        "Each photo shows the moment of the touch, with hand and sensor, and frames of a run are nearly the same.",
    ),
    unverified=(
        "that frames that label.txt does not list are without contact; the first of them is the no-contact frame",
        "sizes of the photos",
    ),
)
_LINE = re.compile(r"(?P<sequence>[\w.-]+)/(?P<frame>\d{1,18})\.jpg,(?P<label>-?\d{1,6})\s*")
_CATEGORY = re.compile(r"\s*(?P<name>[^:]+?)\s*:\s*(?P<label>-?\d{1,6})\b.*")


@dataclass
class _ContactRun:
    """Frames in contact with one material, first to last, without a gap."""

    sequence: str
    first: int
    last: int
    label: int

    @property
    def object_id(self) -> str:
        return f"{self.sequence}-{self.first:010d}"

    def frames(self, number: int) -> list[int]:
        """Return this number of frames, evenly spread from its first to its last; all of them for 0."""
        count = self.last - self.first + 1
        if not number or number >= count:
            return list(range(self.first, self.last + 1))
        return [self.first + round((index + 0.5) * count / number - 0.5) for index in range(number)]


def import_touch_and_go(src: Path, out: Path, progress: Progress | None = None, *, frames: int = 5) -> Recording:
    """Import the labelled frames below `src`.

    Args:
        src: Folder of the data set.
        out: Recording folder to write or continue.
        progress: Called with (done, total) after each grasp.
        frames: Grasps per run; 0 for all frames.

    Raises:
        ImporterError: label.txt is missing or lists no frame, or `frames` is invalid.
    """
    if frames < 0:
        raise ImporterError(f"frames must be at least 1, or 0 for all, got {frames}")
    src = Path(src)
    labels = src / "label.txt"
    if not labels.is_file():
        raise DATA_SET.mismatch_error(src, "it has no label.txt")
    runs, skipped = _runs(labels)
    if not runs:
        raise DATA_SET.mismatch_error(src, "its label.txt lists no frame, such as 20220601_182052/0000033833.jpg,3")
    first = src / "dataset" / runs[0].sequence
    if first.is_dir() and not (first / "gelsight_frame").is_dir():
        raise DATA_SET.mismatch_error(
            src, f"{first.name} has no gelsight_frame/; run the authors' extract_frame.py first"
        )
    splits, leaks = _read_splits(src, runs)
    materials = _materials(src / "category_reference.txt")
    objects = {
        run.object_id: {"label": run.label, "material": materials.get(run.label, "unknown"), "sequence": run.sequence}
        for run in runs
    }
    return import_items(
        replace(DATA_SET, caveats=(*DATA_SET.caveats, *leaks)),
        _items(src / "dataset", runs, skipped, frames),
        out,
        total=len(skipped) + sum(len(run.frames(frames)) for run in runs),
        progress=progress,
        metadata=DataSetMetadata(objects, splits),
    )


def _lines(path: Path) -> Iterator[tuple[str, int, int] | None]:
    """Yield (sequence, frame, label) of each line, or None for an invalid one."""
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            for line in file:
                found = _LINE.fullmatch(line.rstrip("\n"))
                if found and found["sequence"].strip("."):
                    yield found["sequence"], int(found["frame"]), int(found["label"])
                elif line.strip():
                    yield None
    except OSError as error:
        raise ImporterError(f"{path} cannot be read: {error.strerror}") from error


def _runs(path: Path) -> tuple[list[_ContactRun], list[Skip]]:
    """Return the runs of frames in label.txt, in its order, and a `Skip` for each unusable line."""
    runs: list[_ContactRun] = []
    skipped = []
    for number, line in enumerate(_lines(path), start=1):
        if line is None:
            skipped.append(Skip("a line of label.txt is not <sequence>/<frame>.jpg,<label>", f"line {number}"))
            continue
        sequence, frame, label = line
        if label < 0:
            skipped.append(Skip("its label is negative", f"{sequence}/{frame:010d}"))
        elif runs and (runs[-1].sequence, runs[-1].last + 1, runs[-1].label) == (sequence, frame, label):
            runs[-1].last = frame
        else:
            runs.append(_ContactRun(sequence, frame, frame, label))
    return runs, skipped


def _items(folder: Path, runs: list[_ContactRun], skipped: list[Skip], frames: int) -> Iterator[Item | Skip]:
    yield from skipped
    no_contact = _NoContactFrames(folder, runs)
    for run in runs:
        video = folder / run.sequence
        before = no_contact.of(run.sequence)
        for frame in run.frames(frames):
            name = f"{frame:010d}.jpg"
            images: Images = {"photo": video / "video_frame" / name, "touch_a": video / "gelsight_frame" / name}
            if before is not None:
                images = {**images, "touch_a_before": SharedImage(safe_name(run.sequence, "no_contact"), before)}
            yield Item(safe_name(run.sequence, f"{frame:010d}"), run.object_id, images, {"sequence_id": run.sequence})


class _NoContactFrames:
    """The first frame of each video that label.txt does not list."""

    def __init__(self, folder: Path, runs: list[_ContactRun]) -> None:
        self._folder = folder
        self._runs: dict[str, list[_ContactRun]] = {}
        for run in runs:
            self._runs.setdefault(run.sequence, []).append(run)
        self._found: dict[str, Path | None] = {}

    def of(self, sequence: str) -> Path | None:
        """Return the file of this frame; None if it is missing."""
        if sequence not in self._found:
            frame = 0
            for run in sorted(self._runs[sequence], key=lambda run: run.first):
                frame = run.last + 1 if run.first <= frame <= run.last else frame
            path = self._folder / sequence / "gelsight_frame" / f"{frame:010d}.jpg"
            self._found[sequence] = path if path.is_file() else None
        return self._found[sequence]


def _materials(path: Path) -> dict[int, str]:
    """Return the names of the labels; none if the file is missing."""
    try:
        lines = path.read_text("utf-8", "replace").splitlines()
    except OSError:
        return {}
    return {int(found["label"]): found["name"] for line in lines if (found := _CATEGORY.fullmatch(line))}


def _read_splits(src: Path, runs: list[_ContactRun]) -> tuple[dict[str, Split], list[str]]:
    """Return the splits of train.txt and test.txt by whole videos, and notes; nothing if a file is missing."""
    files = {part: src / f"{part}.txt" for part in ("train", "test")}
    if not all(path.is_file() for path in files.values()):
        return {}, []
    by_sequence: dict[str, list[_ContactRun]] = {}
    for run in sorted(runs, key=lambda run: run.first):
        by_sequence.setdefault(run.sequence, []).append(run)
    split = RowSplit("published")
    for part, path in files.items():
        for line in _lines(path):
            candidates = by_sequence.get(line[0], []) if line else []
            index = bisect_right(candidates, line[1], key=lambda run: run.first) - 1 if line else -1
            if line and index >= 0 and line[1] <= candidates[index].last:
                split.add(part, candidates[index].object_id, line[0])
    return split.object_splits()
