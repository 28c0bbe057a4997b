"""Error against run time of the kernels.

The kernels are the simulated rig, canonical correlations, photos decoded at reduced size, and the number format of
training. `python -m benchmarks.frontier --out report/` measures and plots them as `retrieve frontier` does for a
search.
"""

from typing import Any

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

APPROXIMATIONS: Registry[Any] = Registry(
    "approximation",
    "approximations",
    {
        "reduced": "benchmarks.frontier.large_photos:reduced",
        "training_formats": "benchmarks.frontier.training:training_formats",
        "cca_solver": "benchmarks.frontier.correlation:cca_solver",
        "rays": "benchmarks.frontier.rays:rays",
        "sky_occlusion": "benchmarks.frontier.light:sky",
        "contact": "benchmarks.frontier.contact:contact",
        "contact_products": "benchmarks.frontier.contact:contact_products",
        "gel_optics": "benchmarks.frontier.optics:gel_optics",
    },
    error=ConfigError,
)

NEED_NO_MODEL = frozenset({"cca_solver", "rays", "sky_occlusion", "contact", "contact_products", "gel_optics"})
"""Approximations that need neither a model nor a recording."""
