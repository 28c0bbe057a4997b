"""Evaluate methods by protocols: the split of a recording or a real data set, the queries, controls and measures."""

from typing import Any

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

UNSEEN_OBJECTS = "unseen-objects"
"""Name of the protocol of any recording: a split into training, validation and test objects."""
PROTOCOLS: Registry[Any] = Registry(
    "protocol",
    "protocols",
    {
        UNSEEN_OBJECTS: "retrieval.evaluation.protocols.recording:UNSEEN_OBJECTS",
        "vt60-choices": "retrieval.evaluation.protocols.vt60:CHOICES",
        "vt60-seen-classes": "retrieval.evaluation.protocols.vt60:SEEN_CLASSES",
        "vt60-random": "retrieval.evaluation.protocols.vt60:RANDOM",
        "vt60-classes": "retrieval.evaluation.protocols.vt60:CLASSES",
        "billets-unseen": "retrieval.evaluation.protocols.billets:UNSEEN",
        "billets-places": "retrieval.evaluation.protocols.billets:PLACES",
        "objectfolder": "retrieval.evaluation.protocols.published:OBJECTFOLDER",
        "touch-to-touch": "retrieval.evaluation.touch_to_touch:ACROSS",
        "touch-to-touch-within": "retrieval.evaluation.touch_to_touch:WITHIN",
        "physiclear": "retrieval.evaluation.touch_to_touch:PHYSICLEAR",
        "physiclear-sessions": "retrieval.evaluation.touch_to_touch:PHYSICLEAR_SESSIONS",
        "estimate-modulus": "retrieval.evaluation.touch_to_touch:ESTIMATE_MODULUS",
        "vt60-touches": "retrieval.evaluation.touch_to_touch:VT60",
        "feeling-of-success": "retrieval.evaluation.protocols.published:FEELING_OF_SUCCESS",
    },
    error=ConfigError,
    base="retrieval.evaluation.protocol:Protocol",
)
