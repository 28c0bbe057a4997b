"""Benchmark protocols of real data sets: splits, queries, measures and published results."""

from typing import TYPE_CHECKING

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

if TYPE_CHECKING:
    from retrieval.evaluation.real.protocol import Protocol

SCHEMA_VERSION = 3
"""Schema version of the benchmark's results.json."""
PROTOCOLS: "Registry[Protocol]" = Registry(
    "protocol",
    "protocols",
    {
        "vt60-choices": "retrieval.evaluation.real.vt60:CHOICES",
        "vt60-seen-classes": "retrieval.evaluation.real.vt60:SEEN_CLASSES",
        "vt60-random": "retrieval.evaluation.real.vt60:RANDOM",
        "vt60-classes": "retrieval.evaluation.real.vt60:CLASSES",
        "billets-unseen": "retrieval.evaluation.real.billets:UNSEEN",
        "billets-places": "retrieval.evaluation.real.billets:PLACES",
        "objectfolder": "retrieval.evaluation.real.objectfolder:PUBLISHED",
        "rct": "retrieval.evaluation.real.rct:MATERIALS",
        "physiclear": "retrieval.evaluation.real.physiclear:LEAVE_ONE_VIDEO_OUT",
        "feeling-of-success": "retrieval.evaluation.real.feeling_of_success:PAPER",
    },
    error=ConfigError,
    base="retrieval.evaluation.real.protocol:Protocol",
)
