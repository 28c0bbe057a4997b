"""Error against run time of every approximation in the system, and the hard cases of every numerical kernel.

A new approximation is one function from a `Sample` to a `Row`, one row of `APPROXIMATIONS`, one test parameter.
"""

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING

from retrieval.errors import ConfigError

if TYPE_CHECKING:
    from retrieval.lab.frontier.points import Row
    from retrieval.lab.frontier.sample import Sample

APPROXIMATIONS = {
    "candidates": "retrieval.lab.frontier.candidates:candidates",
    "index_kinds": "retrieval.lab.frontier.kinds:index_kinds",
    "towers": "retrieval.lab.frontier.formats:towers",
    "training_formats": "retrieval.lab.frontier.training:training_formats",
    "halves": "retrieval.lab.frontier.formats:halves",
    "image_size": "retrieval.lab.frontier.pixels:image_size",
    "reduced": "retrieval.lab.frontier.large:reduced",
    "grasps": "retrieval.lab.frontier.grasps:grasps",
    "cca_solver": "retrieval.lab.frontier.correlation:cca_solver",
    "cca_components": "retrieval.lab.frontier.correlation:cca_components",
    "rays": "retrieval.lab.frontier.rays:rays",
    "hidden_sky": "retrieval.lab.frontier.light:sky",
    "contact": "retrieval.lab.frontier.contact:contact",
    "contact_products": "retrieval.lab.frontier.contact:contact_products",
    "closing": "retrieval.lab.frontier.contact:closing",
    "gel_optics": "retrieval.lab.frontier.optics:gel_optics",
}
"""Name -> the function that measures it, imported when it is used."""

NEED_NOTHING = frozenset({"cca_solver", "rays", "hidden_sky", "contact", "contact_products", "closing", "gel_optics"})
"""Measured without a model and without a recording."""


def load_approximation(name: str) -> "Callable[[Sample], Row]":
    """The function that measures `name`. Raises ConfigError for an unknown one."""
    if name not in APPROXIMATIONS:
        raise ConfigError(f"an approximation must be one of {', '.join(APPROXIMATIONS)}; got {name!r}")
    module, function = APPROXIMATIONS[name].split(":")
    measure: Callable[[Sample], Row] = getattr(import_module(module), function)
    return measure
