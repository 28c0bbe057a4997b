"""Error and run time of every approximation of a search, measured with one model on one recording.

A new approximation is one function from a `Sample` to an `ApproximationResult`, one row of `APPROXIMATIONS` and one
test parameter. Approximations of kernels, which need no recording, are in `benchmarks/frontier/` of the repository.
"""

from typing import TYPE_CHECKING

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from retrieval.frontier.points import ApproximationResult
    from retrieval.frontier.sample import Sample

    Approximations = Registry[Callable[[Sample], ApproximationResult]]

APPROXIMATIONS: "Approximations" = Registry(
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
