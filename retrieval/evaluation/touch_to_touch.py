"""Touch to touch: identify an object from other touches of it, in another session if there are several.

A sequence is one vector: the mean of its touches' tower features, minus the features of its no-contact frame if every
sequence has one. If objects are touched one after the other, drift makes the no-contact frame of a sequence identify
its object; so it is a control.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from retrieval.data.dataset import Split
from retrieval.evaluation.aggregate import Aggregation, protocol_result
from retrieval.evaluation.inputs import TowerEncoder, clock_features, missing_no_contact_reason
from retrieval.evaluation.protocol import Protocol, RecordingFacts
from retrieval.evaluation.results import ProtocolResult, RowResult
from retrieval.evaluation.sequences import Sequences, Sessions, Vectors
from retrieval.metrics import registry
from retrieval.metrics.registry import Metric

FROZEN = "frozen"
"""Row name of the configuration's own towers."""
METHOD = "nearest"
"""Method of the rows and controls: the nearest sequence."""

MEASURES = {
    "recall_1": Metric("top-1", "real", lambda of: registry.recall(of.test, 1)),
    "recall_5": Metric("R@5", "real", lambda of: registry.recall(of.test, 5)),
    "map": Metric("mAP", "real", lambda of: registry.average_precision(of.test)),
}
"""Measures of sequence-to-sequence retrieval; the first one decides."""


@dataclass(frozen=True)
class TouchToTouch(Protocol):
    """A protocol without training: sequences of touches are queries, other ones are the gallery.

    Methods are not fitted; a row is a tower.

    Attributes:
        sessions: The gallery of a recording with several sessions.
        left_out: A class whose objects are left out.
    """

    folds: Any = lambda facts, seed: []
    measures: Mapping[str, Metric] = dataclasses.field(default_factory=lambda: MEASURES)
    controls: Mapping[str, str] = dataclasses.field(
        default_factory=lambda: dict.fromkeys(("order", "no_contact", "permuted"), METHOD)
    )
    sessions: Sessions = "across"
    left_out: str | None = None


_NOT_TRAINED = "Nothing is trained: the nearest sequence of touches of the gallery gives the object."
_VIDEOS = "A sequence is a press video: the mean of its frames of strongest contact."

ACROSS = TouchToTouch(None, "Touch to touch", _NOT_TRAINED)
WITHIN = dataclasses.replace(ACROSS, title="Touch to touch, within a session", sessions="within")
PHYSICLEAR = TouchToTouch(
    "physiclear",
    "PhysiCLeAR: touch to touch, one video left out",
    "Each press video is the query once. The gallery contains the other videos of all parts; the nearest one gives "
    "the part. Nothing is trained. A video is the mean of its frames of strongest contact. The videos of a part were "
    "recorded one after the other. The order of capture is that of the file names, part by part, as no times are "
    "published.",
    sessions="all",
)
PHYSICLEAR_SESSIONS = TouchToTouch(
    "physiclear", "PhysiCLeAR: touch to touch, across sessions", f"{_NOT_TRAINED} {_VIDEOS}"
)
ESTIMATE_MODULUS = TouchToTouch(
    "estimate-modulus", "EstimateModulus: touch to touch, across days", f"{_NOT_TRAINED} {_VIDEOS}"
)
VT60 = TouchToTouch(
    "vt60",
    "VT60: touch to touch, late touches against early ones",
    f"{_NOT_TRAINED} 08_bottlefull is left out, because it is 02_bottleempty filled.",
    left_out="bottlefull",
)


def _vectors(
    sequences: Sequences, towers: TowerEncoder, variant: str, with_frames: bool
) -> tuple[Vectors, Vectors | None]:
    """Return the vectors (S, F) of the sequences and of their no-contact frames, for "touch" or "low_pass" images.

    `with_frames` is whether each sequence has a no-contact frame of its own, which is then subtracted.
    """
    vectors = sequences.mean(towers.touches(sequences.grasps, variant))
    if not with_frames:
        return vectors, None
    first = [sequences.grasps[rows[0]] for rows in sequences.rows]
    frames = [dataclasses.replace(grasp, touches=grasp.backgrounds) for grasp in first]
    no_contact = towers.touches(frames, variant).astype(np.float64)
    return vectors - no_contact, no_contact


def run_touch_to_touch(
    protocol: TouchToTouch, facts: RecordingFacts, towers_of: Mapping[str, TowerEncoder], seeds: Sequence[int]
) -> ProtocolResult:
    """Return the results of the protocol.

    The rows of towers are compared with the first one. `seeds` are those of the permutations of the objects.

    Raises:
        DatasetError: Second sequences, or common objects of sessions, are missing.
    """
    grasps = facts.grasps
    if protocol.left_out:
        grasps = [grasp for grasp in grasps if facts.class_of.get(grasp.object_id) != protocol.left_out]
    sequences = Sequences.of(grasps, protocol.sessions)
    reason = missing_no_contact_reason(sequences.grasps)
    measured = partial(sequences.measures, protocol.measures)
    measures = {("", "order"): measured(clock_features(len(sequences.names)).astype(np.float64))}
    rows: dict[str, RowResult] = {}
    first, *others = towers_of
    for row, towers in towers_of.items():
        digest = towers.checkpoint.digest if towers.checkpoint else None
        rows[row] = RowResult(METHOD, digest, best_params=[])
        touch, no_contact = _vectors(sequences, towers, "touch", not reason)
        low_pass, _ = _vectors(sequences, towers, "low_pass", not reason)
        measures |= {(row, "touch"): measured(touch), (row, "low_pass"): measured(low_pass)}
        if no_contact is not None:
            measures[row, "no_contact"] = measured(no_contact)
        if row == first:
            measures["", "permuted"] = measured(touch, seeds)
    if not reason:
        measures["", "no_contact"] = measures[first, "no_contact"]
    label = protocol.measures[protocol.main].label
    parts = {
        f"{protocol.main}_{number}": Metric(f"{label}, {one.name}", "real", protocol.measures[protocol.main].compute)
        for number, one in enumerate(sequences.rounds)
        if len(sequences.rounds) == 2
    }
    how = " Features are compared minus those of the no-contact frame."
    if reason:
        how = f" Features of the touches themselves are compared: {reason}."
    return protocol_result(
        dataclasses.replace(
            protocol, rule=f"{protocol.rule} {sequences.rule}{how}".strip(), measures={**protocol.measures, **parts}
        ),
        facts,
        [[Split(seeds[0], (), (), (sequences.names[row],)) for one in sequences.rounds for row in one.queries]],
        rows,
        measures,
        [(other, first) for other in others],
        Aggregation(seeds[0]),
        {"no_contact": reason} if reason else {},
    )
