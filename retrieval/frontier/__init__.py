"""Error and run time of every approximation of a search, measured with one model on one recording.

A new approximation is one function from a `Sample` to an `ApproximationResult`, one row of `APPROXIMATIONS` and one
test parameter. Approximations of kernels, which need no recording, are in `benchmarks/frontier/` of the repository.
"""

from typing import Any

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

APPROXIMATIONS: Registry[Any] = Registry(
    "approximation",
    "approximations",
    {
        "candidates": "retrieval.frontier.candidates:candidates",
        "index_kinds": "retrieval.frontier.candidates:index_kinds",
        "towers": "retrieval.frontier.formats:towers",
        "partials": "retrieval.frontier.formats:partials",
    },
    error=ConfigError,
)
