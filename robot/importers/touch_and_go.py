"""Touch and Go: GelSight videos of people touching things indoors and outdoors, with egocentric videos.

    label.txt                                     a line per frame in contact: "20220601_182052/0000033833.jpg,3"
    category_reference.txt                        "Name: id"
    dataset/<sequence>/{video_frame,gelsight_frame}/<frame>.jpg     the same name in both is one moment
    train.txt, test.txt                           published splits, of the authors' code; lines as in label.txt

The frames are there once the authors' extract_frame.py has cut the videos up.
The data set names materials, not objects. An unbroken run of frames in contact with one material is taken for one
object, `<sequence>-<first frame>`, and `frames` of it, evenly spread, for its grasps (0: all). A video is a sequence:
no split of objects may part its runs. The untouched gel of a video is its first frame that no line names.
"""

import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from robot.errors import ImporterError
from robot.importers.importing import DataSet, DataSetMetadata, Images, Item, Progress, Skip, import_items, safe_name
from robot.importers.row_splits import RowSplit, Split
from robot.recording.folder import Recording, SharedImage

DATA_SET = DataSet(
    source="touch-and-go.github.io",
    licence="as touch-and-go.github.io says",
    citation="Yang, Ma, Zhang, Zhu, Yuan, Owens, Touch and Go: Learning from Human-Collected Vision and Touch, NeurIPS "
    "2022 Datasets and Benchmarks",
    sensor="GelSight",
    rig="by hand, camera on the head",
    expects="`label.txt` and `dataset/<sequence>/{video_frame,gelsight_frame}/<frame>.jpg`",
    background="one frame a video",
    caveats=(
        "An object here is a run of frames in contact with one material: a surrogate, for the data set names no "
        "instances. Two runs of a video may touch one thing, so split by sequence_id.",
        "Each photo is of the moment of the touch: hand and sensor are in it, and frames of a run are nearly alike.",
    ),
    unverified=(
        "that frames which label.txt does not name are without contact, of which the first serves as the untouched gel",
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

    def frames(self, wanted: int) -> list[int]:
        """So many of its frames, evenly spread from its first to its last; all of them for 0."""
        count = self.last - self.first + 1
        if not wanted or wanted >= count:
            return list(range(self.first, self.last + 1))
        return [self.first + round((number + 0.5) * count / wanted - 0.5) for number in range(wanted)]


def import_touch_and_go(src: Path, out: Path, progress: Progress | None = None, *, frames: int = 5) -> Recording:
    """Import the labelled frames below `src`. Raises ImporterError where label.txt names none."""
    if frames < 0:
        raise ImporterError(f"frames must be 1 or more of each run, or 0 for all, got {frames}")
    src = Path(src)
    labels = src / "label.txt"
    if not labels.is_file():
        raise DATA_SET.mismatch_error(src, "it has no label.txt")
    runs, skipped = _runs(labels)
    if not runs:
        raise DATA_SET.mismatch_error(src, "its label.txt names no frame, such as 20220601_182052/0000033833.jpg,3")
    first = src / "dataset" / runs[0].sequence
    if first.is_dir() and not (first / "gelsight_frame").is_dir():
        raise DATA_SET.mismatch_error(
            src, f"{first.name} has no gelsight_frame/; run the authors' extract_frame.py first"
        )
    splits, said = _read_splits(src, runs)
    materials = _materials(src / "category_reference.txt")
    objects = {
        run.object_id: {"label": run.label, "material": materials.get(run.label, "unknown"), "sequence": run.sequence}
        for run in runs
    }
    return import_items(
        replace(DATA_SET, caveats=(*DATA_SET.caveats, *said)),
        _items(src / "dataset", runs, skipped, frames),
        out,
        total=len(skipped) + sum(len(run.frames(frames)) for run in runs),
        progress=progress,
        metadata=DataSetMetadata(objects, splits),
    )


def _lines(path: Path) -> Iterator[tuple[str, int, int] | None]:
    """(sequence, frame, label) of each line, None for one that is none. Raises ImporterError."""
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
    """Runs of the frames that label.txt names, in its order, and its lines that cannot be used."""
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
        at = folder / run.sequence
        before = no_contact.of(run.sequence)
        for frame in run.frames(frames):
            name = f"{frame:010d}.jpg"
            images: Images = {"photo": at / "video_frame" / name, "touch_a": at / "gelsight_frame" / name}
            if before is not None:
                images = {**images, "touch_a_before": SharedImage(safe_name(run.sequence, "no_contact"), before)}
            yield Item(safe_name(run.sequence, f"{frame:010d}"), run.object_id, images, {"sequence_id": run.sequence})


class _NoContactFrames:
    """The first frame of each video that no line names."""

    def __init__(self, folder: Path, runs: list[_ContactRun]) -> None:
        self._folder = folder
        self._runs: dict[str, list[_ContactRun]] = {}
        for run in runs:
            self._runs.setdefault(run.sequence, []).append(run)
        self._found: dict[str, Path | None] = {}

    def of(self, sequence: str) -> Path | None:
        """Its file, None where there is none."""
        if sequence not in self._found:
            frame = 0
            for run in sorted(self._runs[sequence], key=lambda run: run.first):
                frame = run.last + 1 if run.first <= frame <= run.last else frame
            path = self._folder / sequence / "gelsight_frame" / f"{frame:010d}.jpg"
            self._found[sequence] = path if path.is_file() else None
        return self._found[sequence]


def _materials(path: Path) -> dict[int, str]:
    """Names of the labels; none where the file is not there."""
    try:
        lines = path.read_text("utf-8", "replace").splitlines()
    except OSError:
        return {}
    return {int(found["label"]): found["name"] for line in lines if (found := _CATEGORY.fullmatch(line))}


def _read_splits(src: Path, runs: list[_ContactRun]) -> tuple[dict[str, Split], list[str]]:
    """Splits by whole runs and videos of train.txt and test.txt, where both are there, and what is to be said."""
    files = {part: src / f"{part}.txt" for part in ("train", "test")}
    if not all(path.is_file() for path in files.values()):
        return {}, []
    by_sequence: dict[str, list[_ContactRun]] = {}
    for run in sorted(runs, key=lambda run: run.first):
        by_sequence.setdefault(run.sequence, []).append(run)
    split = RowSplit("published")
    for part, path in files.items():
        for line in _lines(path):
            known = by_sequence.get(line[0], []) if line else []
            at = bisect_right(known, line[1], key=lambda run: run.first) - 1 if line else -1
            if line and at >= 0 and line[1] <= known[at].last:
                split.add(part, known[at].object_id, line[0])
    return split.object_splits()
