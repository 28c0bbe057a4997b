"""Any recording: unseen objects of one split, each method described in depth."""

import dataclasses

from retrieval.data.check.split import require_fit
from retrieval.data.dataset import Split, make_split
from retrieval.errors import DatasetError
from retrieval.evaluation.inputs import CONTROL_CCA
from retrieval.evaluation.protocol import Protocol, RecordingFacts, split_of
from retrieval.metrics.registry import METRICS
from retrieval.model.checkpoint import Checkpoint
from retrieval.model.config import TrainingConfig

_RULE = (
    "Methods are fitted on the training objects; settings are selected and probabilities calibrated on the validation "
    "objects; the results are from the test objects. A touch is never compared with the photo of its own grasp. "
)


UNSEEN_OBJECTS = Protocol(
    None,
    "Unseen objects",
    f"{_RULE}The split is drawn.",
    lambda facts, seed: [make_split(facts.grasps, validation=0.15, test=0.15, seed=seed)],
    METRICS,
    controls={"permuted": "cca", "no_contact": "cca", "low_pass": "late_fusion"},
    ceilings=dict.fromkeys(("touch_to_touch", "photo_to_photo"), "cca"),
    control_measures=("pair_accuracy", "topn_k5", "topn_k10"),
    max_grasps={"train": 2, "validation": 12},
    in_depth=True,
)


def with_split(
    facts: RecordingFacts, settings: TrainingConfig, model: Checkpoint | None, requested: Split | None
) -> Protocol:
    """Return the protocol with the requested split, else the model's own, else a new one as `settings` state.

    Raises:
        DatasetError: The requested split does not fit the recording, or the recording has some, but not all training
            objects of the model.
    """
    own = model.split if model else None
    trained = {*own.train, *own.validation} if own else set()
    recorded = {grasp.object_id for grasp in facts.grasps}
    if requested is not None:
        require_fit(requested, facts.grasps)
        split, origin = requested, "given"
    elif own and trained and trained <= recorded:
        split, origin = dataclasses.replace(own, test=own.test or tuple(sorted(recorded - trained))), "the model's own"
    elif shared := trained & recorded:
        raise DatasetError(
            f"The recording must contain all training objects of the model or none of them, but contains {len(shared)} "
            f"of {len(trained)}, such as {min(shared)}. Give a split with --split, or other towers with --config."
        )
    else:
        fractions = {"validation": settings.validation_fraction, "test": settings.test_fraction}
        split = make_split(facts.grasps, seed=settings.seed, **fractions)
        origin = "drawn; the model was trained on none of its objects" if model else "drawn"
    protocol = dataclasses.replace(UNSEEN_OBJECTS, rule=f"{_RULE}The split is {origin}.", folds=lambda *_: [split])
    return _across_sessions(protocol, facts, split) if len(facts.sessions) > 1 else protocol


def _across_sessions(protocol: Protocol, facts: RecordingFacts, split: Split) -> Protocol:
    """Return the protocol with queries of other sessions than all else, if the sessions share enough objects."""
    first, *others = facts.sessions
    known, later = facts.sessions[first], set().union(*(facts.sessions[one] for one in others))
    parts = [
        [name for name in names if name in objects]
        for names, objects in ((split.train, known), (split.validation, known), (split.test, known & later))
    ]
    if min(map(len, parts)) < 2:
        text = " The sessions share too few objects for queries of another session, so drift may identify objects."
        return dataclasses.replace(protocol, rule=protocol.rule + text)
    names = ", ".join(one or "unnamed" for one in others)
    text = (
        f" Queries are the touches of test objects in session {names}; all other touches and all photos are of session "
        f"{first or 'unnamed'}."
    )
    return dataclasses.replace(
        protocol,
        rule=protocol.rule + text,
        folds=lambda *_: [split_of(split.seed, *parts)],
        controls={**protocol.controls, "order": CONTROL_CCA},
        across_sessions=True,
    )
