"""Touch to touch: identify an object from other touches of it, in another session if there are several.

A sequence is one vector: the mean of its touches' tower features, in one of these representations:

    difference      features of the touches, minus those of the no-contact frame
    common-frame    features of the contact difference (touch minus no-contact frame) on ONE common no-contact frame
    plain           features of the touches, if the recording lacks the no-contact frame of each sequence

If objects are touched one after the other, drift makes the no-contact frame of a sequence identify its object. The
first representation retains part of that leak; the second one removes additive effects in the image. Across sessions
the first one, or plain, is also compared `centred`: minus its mean over all sequences of the same session.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from _touch_retrieval.files import write_atomically
from retrieval.console.progress import Bar
from retrieval.data.dataset import Grasp, Split
from retrieval.data.images import encode_image, read_rgb
from retrieval.errors import DatasetError
from retrieval.evaluation.aggregate import Aggregation, protocol_result
from retrieval.evaluation.inputs import TowerEncoder, clock_features, missing_no_contact_reason
from retrieval.evaluation.protocol import Protocol, RecordingFacts
from retrieval.evaluation.results import ProtocolResult, RowResult
from retrieval.evaluation.sequences import Sequences, Sessions, Vectors
from retrieval.metrics import registry
from retrieval.metrics.registry import Metric

FROZEN = "frozen"
"""Row name of the configuration's own towers."""
CENTRED = "-centred"
"""End of the row name of a representation from which the mean of the session was subtracted."""
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

    Methods are not fitted; a row is a tower with one of the representations.

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


def with_common_frame(grasps: Sequence[Grasp], folder: Path) -> list[Grasp]:
    """Return the grasps with images of their contact differences on one common no-contact frame, that of the first.

    An image is common + touch - no-contact frame, clipped to 8 bits. It is written to `folder`, unless it exists.

    Raises:
        DatasetError: The frames differ in size.
    """
    common = [read_rgb(path) for path in grasps[0].backgrounds]
    folder.mkdir(parents=True, exist_ok=True)
    found = []
    with Bar("taking differences to one no-contact frame", len(grasps), "grasps") as bar:
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
    """Return vectors (S, F) of each representation and of the no-contact frame, for "touch" or "low_pass" images.

    `common` are the grasps on one common no-contact frame; none if sequences have no such frames of their own.
    """
    found = {"plain": sequences.mean(towers.touches(sequences.grasps, variant))}
    if common:
        first = [sequences.grasps[rows[0]] for rows in sequences.rows]
        frames = [dataclasses.replace(grasp, touches=grasp.backgrounds) for grasp in first]
        no_contact = towers.touches(frames, variant).astype(np.float64)
        found = {
            "difference": found["plain"] - no_contact,
            "common-frame": sequences.mean(towers.touches(common, variant)),
            "no_contact": no_contact,
        }
    if sequences.is_across_sessions:
        name, vectors = next(iter(found.items()))
        found[f"{name}{CENTRED}"] = sequences.centred(vectors)
    return found


def run_touch_to_touch(
    protocol: TouchToTouch,
    facts: RecordingFacts,
    towers_of: Mapping[str, TowerEncoder],
    seeds: Sequence[int],
    folder: Path,
) -> ProtocolResult:
    """Return the results of the protocol.

    The towers of a row are compared with those of the first row. `seeds` are those of the permutations of the objects;
    `folder` gets the images on the common frame.

    Raises:
        DatasetError: Second sequences, or common objects of sessions, are missing.
    """
    grasps = facts.grasps
    if protocol.left_out:
        grasps = [grasp for grasp in grasps if facts.class_of.get(grasp.object_id) != protocol.left_out]
    sequences = Sequences.of(grasps, protocol.sessions)
    reason = missing_no_contact_reason(sequences.grasps)
    folder = folder / facts.digest[:32] / sequences.grasps[0].grasp_id
    common = [] if reason else with_common_frame(sequences.grasps, folder)
    measured = partial(sequences.measures, protocol.measures)
    measures = {("", "order"): measured(clock_features(len(sequences.names)).astype(np.float64))}
    rows: dict[str, RowResult] = {}
    compared: list[tuple[str, str]] = []
    first = next(iter(towers_of))
    for label, towers in towers_of.items():
        digest = towers.checkpoint.digest if towers.checkpoint else None
        touch, low_pass = (_vectors(sequences, towers, common, variant) for variant in ("touch", "low_pass"))
        no_contact = {kind: measured(touch.pop(kind)) for kind in ("no_contact",) if kind in touch}
        for each, vectors in touch.items():
            row = f"{label}-{each}"
            rows[row] = RowResult(METHOD, digest, best_params=[])
            measures |= {(row, "touch"): measured(vectors), (row, "low_pass"): measured(low_pass[each])}
            for kind, found in no_contact.items():
                measures.setdefault(("", kind), found)
                measures[row, kind] = found
            if ("", "permuted") not in measures:
                measures["", "permuted"] = measured(vectors, seeds)
            if label != first:
                compared.append((row, f"{first}-{each}"))
            if each.endswith(CENTRED):
                compared.append((row, row.removesuffix(CENTRED)))
    label = protocol.measures[protocol.main].label
    parts = {
        f"{protocol.main}_{number}": Metric(f"{label}, {one.name}", "real", protocol.measures[protocol.main].compute)
        for number, one in enumerate(sequences.rounds)
        if len(sequences.rounds) == 2
    }
    why = f" Features of the touches themselves are compared: {reason}." if reason else ""
    return protocol_result(
        dataclasses.replace(
            protocol, rule=f"{protocol.rule} {sequences.rule}{why}".strip(), measures={**protocol.measures, **parts}
        ),
        facts,
        [[Split(seeds[0], (), (), (sequences.names[row],)) for one in sequences.rounds for row in one.queries]],
        rows,
        measures,
        compared,
        Aggregation(seeds[0]),
        {"no_contact": reason} if reason else {},
    )
