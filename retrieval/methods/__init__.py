"""Methods to compare: each scores touches with photos, fitted on the same grasps.

A new method is one file and one row of `METHODS`, or a class in a user's own package. The behaviour tests run on
every row.
"""

from typing import Any

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

METHODS: Registry[Any] = Registry(
    "method",
    "methods",
    {
        "late_fusion": "retrieval.methods.late_fusion:LateFusion",
        "retrieve_rerank": "retrieval.methods.retrieve_rerank:RetrieveRerank",
        "contrastive": "retrieval.methods.contrastive:ContrastiveEmbedding",
        "cca": "retrieval.methods.cca:Cca",
        "cca_towers": "retrieval.methods.cca_towers:CcaTowers",
        "chance": "retrieval.methods.chance:Chance",
    },
    error=ConfigError,
    base="retrieval.methods.method:Method",
)

CHANCE = "chance"
"""Name of the method that ignores its input."""
