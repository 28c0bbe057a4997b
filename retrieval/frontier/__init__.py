"""Error against run time of every approximation in the system, and the hard cases of every numerical kernel.

A new approximation is one function from a `Sample` to a `Row`, one row of `APPROXIMATIONS`, one test parameter.
"""

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING

from retrieval.errors import ConfigError

if TYPE_CHECKING:
    from retrieval.frontier.points import Row
    from retrieval.frontier.sample import Sample

APPROXIMATIONS = {
    "candidates": "retrieval.frontier.candidates:candidates",
    "index_kinds": "retrieval.frontier.kinds:index_kinds",
    "towers": "retrieval.frontier.formats:towers",
    "halves": "retrieval.frontier.formats:halves",
    "image_size": "retrieval.frontier.pixels:image_size",
    "grasps": "retrieval.frontier.grasps:grasps",
    "cca_solver": "retrieval.frontier.correlation:cca_solver",
    "cca_components": "retrieval.frontier.correlation:cca_components",
    "contact": "retrieval.frontier.simulated:contact",
    "closing": "retrieval.frontier.simulated:closing",
    "gel_optics": "retrieval.frontier.simulated:gel_optics",
}
"""Name -> the function that measures it, imported when it is used."""

NEED_NOTHING = frozenset({"cca_solver", "contact", "closing", "gel_optics"})
"""Measured without a model and without a recording."""


def load_approximation(name: str) -> "Callable[[Sample], Row]":
    """The function that measures `name`. Raises ConfigError for an unknown one."""
    if name not in APPROXIMATIONS:
        raise ConfigError(f"an approximation must be one of {', '.join(APPROXIMATIONS)}; got {name!r}")
    module, function = APPROXIMATIONS[name].split(":")
    measure: Callable[[Sample], Row] = getattr(import_module(module), function)
    return measure
