"""Grasps of a recording, object-disjoint splits, and the paper's pair sampler."""

import hashlib
import json
import logging
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.documents import typed
from _touch_retrieval.files import read_regular
from retrieval.errors import DatasetError
from robot.errors import RobotError
from robot.recording.folder import Recording, read_info, read_recording

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Grasp:
    """One interaction, ready to be loaded: a photo, the touch (one file per finger, in order a, b), and the
    no-contact frames of the same fingers where the recording has them (else empty).
    """

    grasp_id: str
    object_id: str
    sequence_id: str | None
    photo: Path
    touches: tuple[Path, ...]
    backgrounds: tuple[Path, ...]


AnyRecording = str | Path | Recording
"""A recording: its folder, or what `robot.read_recording` returns."""


def folder_of(recording: AnyRecording) -> Path:
    """Return the folder of a recording."""
    return recording.folder if isinstance(recording, Recording) else Path(recording)


def load_grasps(recording: AnyRecording) -> list[Grasp]:
    """Read the successful grasps of a recording that have a photo and a touch, in the order of collection.

    Raises DatasetError for an unreadable recording, one without such grasps, or one that mixes numbers of fingers.

    >>> [grasp.object_id for grasp in retrieval.load_grasps("recording")]
    ['mug', 'mug', 'tin', 'tin']
    """
    folder = folder_of(recording)
    return require_accepted(folder, load_all_attempts(folder))


def require_accepted(folder: Path, attempts: Iterable["Attempt"]) -> list[Grasp]:
    """The accepted grasps of a recording read by `load_all_attempts`. Raises DatasetError as `load_grasps` does."""
    grasps = [attempt.grasp for attempt in attempts if attempt.accepted]
    if not grasps:
        raise DatasetError(f"{folder} must hold successful grasps with a photo and a touch; it holds none")
    finger_count(grasps)
    return grasps


@dataclass(frozen=True)
class Attempt:
    """One closing of the gripper, whatever came of it.

    outcome: "held", or what went wrong: "missed", "slipped", "no_plan", or "failed" where the recording does not say
    which; "unknown" where it says nothing. accepted: whether a matcher is trained on it. after: the frames after the
    lift, one file per finger in order, or empty.
    """

    grasp: Grasp
    outcome: str
    accepted: bool
    after: tuple[Path, ...]

    @property
    def held(self) -> bool:
        """Whether the object came up with the gripper."""
        return self.outcome == "held"


def load_all_attempts(folder: Path) -> list[Attempt]:
    """Read every line of a recording, in the order of collection. Raises DatasetError for an unreadable one."""
    try:
        recording = read_recording(folder)
    except RobotError as error:
        raise DatasetError(str(error)) from error
    for note in recording.notes:
        log.warning("%s", note)

    def in_finger_order(files: Mapping[str, str]) -> tuple[Path, ...]:
        return tuple(folder / files[finger] for finger in sorted(files))

    return [
        Attempt(
            Grasp(
                grasp_id=line.grasp_id,
                object_id=line.object_id,
                sequence_id=line.sequence_id,
                photo=folder / line.photo,
                touches=in_finger_order(line.touches),
                backgrounds=in_finger_order(line.touches_before),
            ),
            outcome=line.outcome or {None: "unknown", True: "held", False: "failed"}[line.grasped],
            accepted=line.grasped is not False,
            after=in_finger_order(line.touches_after),
        )
        for line in recording.grasps
    ]


def load_attempts(folder: Path) -> list[Attempt]:
    """Read the successful AND the failed grasps of a recording, in the order of collection.

    A grasp counts by its `outcome`, and where that was not recorded by `grasped`; left out are those with neither,
    and plans that never came to a grasp. Raises DatasetError as `load_grasps` does.
    """
    attempts = [attempt for attempt in load_all_attempts(folder) if attempt.outcome not in ("unknown", "no_plan")]
    if not attempts:
        raise DatasetError(f"{folder} must say of its grasps whether they succeeded (grasped, outcome); none says so")
    finger_count([attempt.grasp for attempt in attempts])
    return attempts


def recording_source(folder: Path) -> str:
    """What a recording says of where it comes from."""
    return str(read_info(folder)["source"])


def finger_count(grasps: Sequence[Grasp]) -> int:
    """Number of gel images of each touch. Raises DatasetError where grasps differ."""
    first = grasps[0]
    for grasp in grasps:
        if len(grasp.touches) != len(first.touches):
            raise DatasetError(
                f"every touch must have the same number of gel images; {first.grasp_id} has {len(first.touches)}, "
                f"{grasp.grasp_id} has {len(grasp.touches)}; keep the sensors in recordings of their own"
            )
    return len(first.touches)


def data_digest(grasps: Iterable[Grasp]) -> str:
    """SHA-256 over ids and image bytes: two recordings with equal digests train alike."""
    digest = hashlib.sha256()
    for grasp in grasps:
        digest.update(json.dumps([grasp.grasp_id, grasp.object_id, grasp.sequence_id]).encode())
        for path in (grasp.photo, *grasp.touches, *grasp.backgrounds):
            try:
                digest.update(hashlib.sha256(read_regular(path)).digest())
            except OSError as error:
                raise DatasetError(f"{path} cannot be read ({error.strerror}); run `retrieve check`") from error
    return digest.hexdigest()


@dataclass(frozen=True)
class Split:
    """Which objects train, which choose and calibrate, which are never seen before the end."""

    seed: int
    train: tuple[str, ...]
    validation: tuple[str, ...]
    test: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain dictionary, as stored in checkpoints and split files."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, data: Any) -> "Split":
        """Inverse of `to_dict`. Raises DatasetError for anything else."""
        return typed(
            {"seed": 0} | data if isinstance(data, dict) else data, cls, "split", complete=True, error=DatasetError
        )

    def select(self, grasps: Iterable[Grasp], part: str) -> list[Grasp]:
        """Grasps whose object lies in `part` ("train", "validation" or "test")."""
        objects = set(getattr(self, part))
        return [grasp for grasp in grasps if grasp.object_id in objects]


def make_split(grasps: Sequence[Grasp], *, validation: float, test: float, seed: int) -> Split:
    """Draw an object-disjoint split; objects that share a sequence stay together.

    validation, test: shares of the objects, each met as closely as whole groups allow; a part that is wanted holds
    at least the two objects that pairs need. Raises DatasetError where the recording has too few for that.

    >>> len(retrieval.make_split(retrieval.load_grasps("lab"), validation=0.2, test=0.25, seed=0).train)
    7
    """
    groups = linked_objects(grasps)
    queue = [groups[index] for index in np.random.default_rng(seed).permutation(len(groups))]
    total = sum(len(group) for group in groups)
    chosen = {
        name: _take(queue, share * total) if share > 0 else ()
        for name, share in (("test", test), ("validation", validation))
    }
    train = tuple(sorted(name for group in queue for name in group))
    wanted = [train] + [chosen[name] for name, share in (("test", test), ("validation", validation)) if share > 0]
    if min(map(len, wanted)) < 2:
        raise DatasetError(
            f"a split into {len(wanted)} parts needs two objects in each, and objects that share a sequence stay "
            f"together; the recording has {total} objects in {len(groups)} such groups, and the shares part them into "
            f"{' + '.join(str(len(part)) for part in wanted)}; record more objects, or give a split of your own"
        )
    return Split(seed=seed, train=train, **chosen)


def _take(queue: list[list[str]], target: float) -> tuple[str, ...]:
    """Take off the queue each group that brings the count closer to the target; the smallest where these hold no two
    objects.
    """
    taken: list[str] = []
    for group in list(queue):
        if abs(len(taken) + len(group) - target) < abs(len(taken) - target):
            taken = taken + group
            queue.remove(group)
    for group in sorted(queue, key=len):
        if len(taken) < 2:
            taken = taken + group
            queue.remove(group)
    return tuple(sorted(taken))


def linked_objects(grasps: Iterable[Grasp]) -> list[list[str]]:
    """Objects joined wherever they share a sequence, which no split may tear apart; groups and members sorted."""
    group_of: dict[str, set[str]] = {}
    first_of_sequence: dict[str, str] = {}
    for grasp in grasps:
        group = group_of.setdefault(grasp.object_id, {grasp.object_id})
        if grasp.sequence_id is None:
            continue
        other = group_of[first_of_sequence.setdefault(grasp.sequence_id, grasp.object_id)]
        if other is not group:
            group |= other
            group_of.update(dict.fromkeys(group, group))
    unique = {id(group): sorted(group) for group in group_of.values()}
    return sorted(unique.values())


@dataclass(frozen=True)
class PairBatch:
    """Pairs over distinct images: every touch and photo is listed once, however many pairs use it.

    grasps: the grasps whose touches are used; photos: distinct photo files. touch_index, photo_index (P,) point into
    them; labels (P,) are 1 for the same object. touch_objects (T,), photo_objects (N,) are integer object labels.
    """

    grasps: list[Grasp]
    photos: list[Path]
    touch_index: NDArray[np.int64]
    photo_index: NDArray[np.int64]
    labels: NDArray[np.float32]
    touch_objects: NDArray[np.int64]
    photo_objects: NDArray[np.int64]


_PhotoDraw = tuple[int, Path, float]


class PairSampler:
    """The paper's pairs: each touch with so many photos of its own object and as many of other objects.

    Stateless: the batch of a step depends on the seed and the step alone, so training resumes anywhere. Touches go
    round the objects, each object once a round in a fresh order, so at any moment every object has been used equally
    often (to within one); within an object, grasps come in shuffled decks. Negatives draw the object first, then one
    of its photos, both uniformly, from the SAME set of grasps.

    share_photos: negatives of a training batch are drawn from the objects of its other touches, and from the photos
    that stand in it as these objects' positives. Objects and photos are as likely as before, for the objects of a batch
    are drawn uniformly and the photos of each too; but a batch of 6 touches has 24 photos to encode where it had up to
    48, and each is looked at as a match and as none, so that what a photo adds to every pair cancels. The variance of
    the head's gradient over batches is 0.6 of the other's at the start of a training and 1.06 at its end (measured on
    the shipped checkpoint's features). It pays where a photo costs a pass through a tower in training.
    """

    def __init__(
        self,
        grasps: Sequence[Grasp],
        *,
        seed: int,
        positives: int = 4,
        negatives: int = 4,
        share_photos: bool = False,
    ) -> None:
        """Raises DatasetError for fewer than two objects, and where one photo file stands for two objects."""
        self.seed, self.positives, self.negatives, self.share_photos = seed, positives, negatives, share_photos
        by_object: dict[str, list[Grasp]] = defaultdict(list)
        for grasp in grasps:
            by_object[grasp.object_id].append(grasp)
        if len(by_object) < 2:
            raise DatasetError(f"pairs need at least 2 objects in each part of the split; got {len(by_object)}")
        self.objects = sorted(by_object)
        self.grasps = [by_object[name] for name in self.objects]
        self.photos = [sorted({grasp.photo for grasp in part}) for part in self.grasps]
        if len({photo for part in self.photos for photo in part}) != sum(map(len, self.photos)):
            raise DatasetError("a photo file must belong to one object; two objects share one; run `retrieve check`")

    def batch(self, step: int, touches: int) -> PairBatch:
        """The pairs of training step `step` (from 0) with `touches` touches."""
        return self._pairs(
            [self._touch(step * touches + turn) for turn in range(touches)], (1, step), self.share_photos
        )

    def evaluation_pairs(self) -> PairBatch:
        """Every touch of the set with its positive and negative photos: the fixed pairs for evaluation."""
        touches = [(index, grasp) for index, part in enumerate(self.grasps) for grasp in part]
        return self._pairs(touches, stream=(2,))

    def _touch(self, turn: int) -> tuple[int, Grasp]:
        round_number, place = divmod(turn, len(self.objects))
        index = int(self._rng(3, round_number).permutation(len(self.objects))[place])
        deck_number, card = divmod(round_number, len(self.grasps[index]))
        deck = self._rng(4, index, deck_number).permutation(len(self.grasps[index]))
        return index, self.grasps[index][int(deck[card])]

    def _pairs(self, touches: list[tuple[int, Grasp]], stream: tuple[int, ...], share: bool = False) -> PairBatch:
        rng = self._rng(*stream)
        photos: dict[Path, int] = {}
        owners: dict[Path, int] = {}
        pairs: list[tuple[int, int, float]] = []
        for row, drawn in enumerate(self._draw_photos([index for index, _ in touches], rng, share)):
            for owner, photo, label in drawn:
                owners[photo] = owner
                pairs.append((row, photos.setdefault(photo, len(photos)), label))
        touch_index, photo_index, labels = zip(*pairs, strict=True)
        return PairBatch(
            grasps=[grasp for _, grasp in touches],
            photos=list(photos),
            touch_index=np.array(touch_index, dtype=np.int64),
            photo_index=np.array(photo_index, dtype=np.int64),
            labels=np.array(labels, dtype=np.float32),
            touch_objects=np.array([index for index, _ in touches], dtype=np.int64),
            photo_objects=np.array([owners[photo] for photo in photos], dtype=np.int64),
        )

    def _draw_photos(self, objects: list[int], rng: np.random.Generator, share: bool) -> Iterator[list[_PhotoDraw]]:
        """Photos to pair with the touch of each object: (object, photo, label). SharedImage negatives are of the batch's
        other objects, taken in turn in a random order, with one of the photos that the batch shows of each; where the
        batch holds no other object they are drawn from all.
        """
        if not share:
            for index in objects:
                matches = [(index, photo, 1.0) for photo in self._positives(index, rng)]
                yield matches + [(*self._negative(index, rng), 0.0) for _ in range(self.negatives)]
            return
        positives = [self._positives(index, rng) for index in objects]
        shown: dict[int, list[Path]] = defaultdict(list)
        for index, drawn in zip(objects, positives, strict=True):
            shown[index] += drawn
        for index, drawn in zip(objects, positives, strict=True):
            others = sorted(set(shown) - {index})
            if others:
                rounds = [rng.permutation(len(others)) for _ in range(-(-self.negatives // len(others)))]
                chosen = [others[turn] for turn in np.concatenate(rounds)[: self.negatives]]
                negatives = [(other, shown[other][int(rng.integers(len(shown[other])))]) for other in chosen]
            else:
                negatives = [self._negative(index, rng) for _ in range(self.negatives)]
            yield [(index, photo, 1.0) for photo in drawn] + [(*negative, 0.0) for negative in negatives]

    def _positives(self, index: int, rng: np.random.Generator) -> list[Path]:
        """Without replacement where the object has enough photos."""
        photos = self.photos[index]
        chosen = rng.choice(len(photos), self.positives, replace=len(photos) < self.positives)
        return [photos[int(row)] for row in chosen]

    def _negative(self, index: int, rng: np.random.Generator) -> tuple[int, Path]:
        other = int(rng.integers(len(self.objects) - 1))
        other += other >= index
        return other, self.photos[other][int(rng.integers(len(self.photos[other])))]

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *stream])


class ImageCache:
    """Loads preprocessed images once and keeps them while they fit in `limit_bytes`.

    Safe to call from several threads; an image that no longer fits is loaded again each time.
    """

    def __init__(self, load: Callable[..., NDArray[Any]], limit_bytes: int = 4 << 30) -> None:
        self._load, self._limit = load, limit_bytes
        self._images: dict[tuple[Path | None, ...], NDArray[Any]] = {}
        self._used = 0

    def __call__(self, *paths: Path | None) -> NDArray[Any]:
        """The image that `load(*paths)` gives."""
        if (image := self._images.get(paths)) is None:
            image = self._load(*paths)
            if self._used + image.nbytes <= self._limit:
                self._images[paths] = image
                self._used += image.nbytes
        return image
