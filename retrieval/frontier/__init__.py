"""Error and run time of every approximation of a search, measured with one model on one recording.

A new approximation is one function from a `Sample` to an `ApproximationResult`, one row of `APPROXIMATIONS` and one
test parameter. Approximations of kernels, which need no recording, are in `benchmarks/frontier/` of the repository.
"""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING

from retrieval.errors import ConfigError

if TYPE_CHECKING:
    from retrieval.frontier.points import ApproximationResult
    from retrieval.frontier.sample import Sample

APPROXIMATIONS = {
    "candidates": "retrieval.frontier.candidates:candidates",
    "index_kinds": "retrieval.frontier.kinds:index_kinds",
    "towers": "retrieval.frontier.formats:towers",
    "partials": "retrieval.frontier.formats:partials",
}
"""Name -> measuring function, imported on first use."""


def load_approximation(
    name: str, table: Mapping[str, str] = APPROXIMATIONS
) -> "Callable[[Sample], ApproximationResult]":
    """Return the function that measures `name`.

    Args:
        name: A key of `table`.
        table: Name -> "module:function".

    Raises:
        ConfigError: The name is unknown.
    """
    if name not in table:
        raise ConfigError(f"an approximation must be one of {', '.join(table)}; got {name!r}")
    module, function = table[name].split(":")
    measure: Callable[[Sample], ApproximationResult] = getattr(import_module(module), function)
    return measure
