"""Touch to touch: identify an object from other touches of it, leaving out one sequence (such as a press video).

A sequence is one vector: the mean of its touches' tower features, in one of two representations:

    difference      features of the touches, minus those of the no-contact frame
    common-frame    features of the contact difference (touch minus no-contact frame) on ONE common no-contact frame

If objects are touched one after the other, drift makes the no-contact frame of a sequence identify its object. The
first representation retains part of that leak; the second one removes additive effects in the image. The score of two
sequences is the cosine of their first principal components; scaling and components are fitted without the query.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from _touch_retrieval.files import write_atomically
from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp, Split
from retrieval.data.images import encode_image, read_rgb
from retrieval.errors import DatasetError
from retrieval.evaluation.aggregate import Aggregation, MeasuresByName, protocol_result
from retrieval.evaluation.inputs import TowerEncoder, clock_features, missing_no_contact_reason
from retrieval.evaluation.protocol import Protocol, RecordingFacts
from retrieval.evaluation.results import ProtocolResult, RowResult
from retrieval.metrics import registry
from retrieval.metrics.measure import Measure, pooled
from retrieval.metrics.registry import MethodScoreTables, Metric
from retrieval.metrics.table import ScoreTable

COMPONENTS = 60
REPRESENTATIONS = ("difference", "common-frame")
FROZEN = "frozen"
"""Row name of the configuration's own towers."""
METHOD = "nearest"
"""Method of the rows and controls: the nearest sequence."""

Vectors = NDArray[np.float64]

MEASURES = {
    "recall_1": Metric("top-1", "real", lambda of: registry.recall(of.test, 1)),
    "recall_5": Metric("R@5", "real", lambda of: registry.recall(of.test, 5)),
    "map": Metric("mAP", "real", lambda of: registry.average_precision(of.test)),
}
"""Measures of sequence-to-sequence retrieval; the first one decides."""


@dataclass(frozen=True)
class TouchToTouch(Protocol):
    """A protocol without training: each sequence of touches is a query, the other sequences are the gallery.

    It needs a no-contact frame for each touch. Methods are not fitted; a row is a tower with one of `REPRESENTATIONS`.
    """

    folds: Any = lambda facts, seed: []
    measures: Mapping[str, Metric] = dataclasses.field(default_factory=lambda: MEASURES)
    controls: Mapping[str, str] = dataclasses.field(
        default_factory=lambda: dict.fromkeys(("order", "no_contact", "permuted"), METHOD)
    )


PHYSICLEAR = TouchToTouch(
    "physiclear",
    "PhysiCLeAR: touch to touch, one video left out",
    "Each press video is the query once. The gallery contains the other videos of all parts; the nearest one gives "
    "the part. Nothing is trained. A video is the mean of its frames of strongest contact. The videos of a part were "
    "recorded one after the other. The order of capture is that of the file names, part by part, as no times are "
    "published.",
)


def leave_one_out_scores(vectors: Vectors, components: int = COMPONENTS) -> NDArray[np.float32]:
    """Return the cosines (S, S) of vectors (S, F) after principal components, at most S - 2; 0 on the diagonal.

    Row q uses mean, standard deviation and components of all vectors but q.
    """
    count = len(vectors)
    scores = np.zeros((count, count), np.float32)
    for row in range(count):
        others = np.arange(count) != row
        mean, deviation = vectors[others].mean(0), vectors[others].std(0)
        scaled = (vectors - mean) / np.where(deviation > 1e-9 * max(1.0, np.abs(mean).max()), deviation, np.inf)
        # Use the Gram matrix: there are fewer sequences than features.
        gallery = scaled[others]
        values, directions = np.linalg.eigh(gallery @ gallery.T)
        used = np.flatnonzero(values > 1e-9 * max(values[-1], 1e-12))[::-1][: min(components, count - 2)]
        codes = scaled @ (gallery.T @ (directions[:, used] / np.sqrt(values[used])))
        norms = np.maximum(np.linalg.norm(codes, axis=1), 1e-12)
        scores[row, others] = (codes[others] @ codes[row]) / (norms[others] * norms[row])
    return scores


@dataclass(frozen=True, eq=False)
class Sequences:
    """The sequences of a recording in the order of capture.

    Attributes:
        grasps: The grasps.
        names: Name of each sequence.
        owner: (S,) object number of each sequence, in the order of the sorted names.
        rows: Places of the grasps of each.
    """

    grasps: Sequence[Grasp]
    names: tuple[str, ...]
    owner: NDArray[np.int64]
    rows: tuple[NDArray[np.int64], ...]

    @classmethod
    def of(cls, grasps: Sequence[Grasp]) -> "Sequences":
        """Group grasps by object and sequence.

        Raises:
            DatasetError: There are fewer than two objects, or an object has fewer than two sequences.
        """
        places: dict[tuple[str, str], list[int]] = {}
        for place, grasp in enumerate(grasps):
            places.setdefault((grasp.object_id, grasp.sequence_id or grasp.grasp_id), []).append(place)
        objects, owner, counts = np.unique([name for name, _ in places], return_inverse=True, return_counts=True)
        if len(objects) < 2 or counts.min() < 2:
            raise DatasetError(
                f"Touch to touch needs at least 2 objects with 2 sequences each, but the recording has {len(objects)} "
                f"object(s), and {objects[counts.argmin()]} has {counts.min()} sequence(s)."
            )
        rows = tuple(np.array(each, np.int64) for each in places.values())
        return cls(grasps, tuple(name for _, name in places), owner, rows)

    def mean(self, features: NDArray[np.float32]) -> Vectors:
        """Return the mean (S, F) of features (G, F) over the grasps of each sequence."""
        return np.stack([features[rows].mean(0, dtype=np.float64) for rows in self.rows])

    def measures(
        self, protocol: Protocol, scores: NDArray[np.float32], owners: Sequence[NDArray[np.int64]] = ()
    ) -> MeasuresByName:
        """Return the measures of scores (S, S): each sequence is a query, and is not compared with itself.

        There is one measure for each of `owners`, which replace the objects of the sequences; else one for these.
        """
        measures: dict[str, list[Measure]] = defaultdict(list)
        for owner in owners or [self.owner]:
            table = ScoreTable(scores, owner, owner, np.eye(len(owner), dtype=np.bool_), "sequences")
            tables = MethodScoreTables(table, table, {}, None, 0)
            for name, metric in protocol.measures.items():
                if measure := metric.compute(tables):
                    measures[name].append(pooled([measure]))
        return measures


def with_common_frame(grasps: Sequence[Grasp], folder: Path, *, quiet: bool = True) -> list[Grasp]:
    """Return the grasps with images of their contact differences on one common no-contact frame, that of the first.

    An image is common + touch - no-contact frame, clipped to 8 bits. It is written to `folder`, unless it exists.

    Raises:
        DatasetError: The frames differ in size.
    """
    common = [read_rgb(path) for path in grasps[0].backgrounds]
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    with Bar("one common frame", len(grasps), "grasps", quiet=quiet) as bar:
        for grasp in grasps:
            files = []
            for finger, (touch, before) in enumerate(zip(grasp.touches, grasp.backgrounds, strict=True)):
                path = folder / f"{grasp.grasp_id}-{finger}.png"
                if not path.is_file():
                    pressed, no_contact, shared = read_rgb(touch), read_rgb(before), common[finger]
                    if not pressed.shape == no_contact.shape == shared.shape:
                        raise DatasetError(
                            f"{touch}, its no-contact frame and the first no-contact frame of the recording must have "
                            f"the same size, got {pressed.shape}, {no_contact.shape} and {shared.shape}."
                        )
                    image = np.rint(255 * (shared + pressed - no_contact))
                    write_atomically(path, encode_image(np.clip(image, 0, 255).astype(np.uint8)))
                files.append(path)
            found.append(dataclasses.replace(grasp, touches=tuple(files), backgrounds=grasps[0].backgrounds))
            bar.advance()
    return found


def _vectors(sequences: Sequences, towers: TowerEncoder, common: Sequence[Grasp], variant: str) -> dict[str, Vectors]:
    """Return vectors (S, F) of each representation and of the no-contact frame, for "touch" or "low_pass" images."""
    first = [sequences.grasps[rows[0]] for rows in sequences.rows]
    frames = [dataclasses.replace(grasp, touches=grasp.backgrounds) for grasp in first]
    no_contact = towers.touches(frames, variant).astype(np.float64)
    return {
        "no_contact": no_contact,
        "difference": sequences.mean(towers.touches(sequences.grasps, variant)) - no_contact,
        "common-frame": sequences.mean(towers.touches(common, variant)),
    }


def run_touch_to_touch(
    protocol: TouchToTouch,
    facts: RecordingFacts,
    towers_of: Mapping[str, TowerEncoder],
    seeds: Sequence[int],
    folder: Path,
    quiet: bool,
) -> ProtocolResult:
    """Return the results of the protocol.

    The towers of a row are compared with those of the first row. `seeds` are those of the permutations of the objects;
    `folder` gets the images on the common frame.

    Raises:
        DatasetError: No-contact frames or second sequences are missing.
    """
    sequences = Sequences.of(facts.grasps)
    if reason := missing_no_contact_reason(facts.grasps):
        raise DatasetError(f"Touch to touch needs the no-contact frame of each sequence: {reason}.")
    common = with_common_frame(facts.grasps, folder / facts.digest[:32], quiet=quiet)
    order = leave_one_out_scores(clock_features(len(sequences.names)).astype(np.float64))
    measures = {("", "order"): sequences.measures(protocol, order)}
    rows: dict[str, RowResult] = {}
    for label, towers in towers_of.items():
        digest = towers.checkpoint.digest if towers.checkpoint else None
        touch, low_pass = (_vectors(sequences, towers, common, variant) for variant in ("touch", "low_pass"))
        no_contact = sequences.measures(protocol, leave_one_out_scores(touch["no_contact"]))
        measures.setdefault(("", "no_contact"), no_contact)
        for each in REPRESENTATIONS:
            row, scores = f"{label}-{each}", leave_one_out_scores(touch[each])
            rows[row] = RowResult(METHOD, digest, best_params=[])
            measures[row, "touch"] = sequences.measures(protocol, scores)
            measures[row, "low_pass"] = sequences.measures(protocol, leave_one_out_scores(low_pass[each]))
            measures[row, "no_contact"] = no_contact
            if ("", "permuted") not in measures:
                owners = [np.random.default_rng([seed, 41]).permutation(sequences.owner) for seed in seeds]
                measures["", "permuted"] = sequences.measures(protocol, scores, owners)
    first, *others = towers_of
    return protocol_result(
        protocol,
        facts,
        [[Split(seeds[0], (), (), (name,)) for name in sequences.names]],
        rows,
        measures,
        [(f"{other}-{each}", f"{first}-{each}") for other in others for each in REPRESENTATIONS],
        Aggregation(seeds[0]),
    )
