"""Fitting of matchers: recipes, trainings, and calibrations.

A new recipe is one class and one row of `RECIPES`, or a class in a user's own package.
"""

from typing import TYPE_CHECKING

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

if TYPE_CHECKING:
    from retrieval.training.recipes import Recipe

RECIPES: "Registry[type[Recipe]]" = Registry(
    "recipe",
    "recipes",
    {
        "start": "retrieval.training.recipes:Start",
        "linear": "retrieval.training.recipes:Linear",
        "head": "retrieval.training.recipes:ContinuedHead",
        "new-head": "retrieval.training.recipes:NewHead",
    },
    error=ConfigError,
    base="retrieval.training.recipes:Recipe",
)
