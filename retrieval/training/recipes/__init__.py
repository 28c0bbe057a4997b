"""Recipes: ways to fit a matcher to a recording, which `retrieval.training.choice` compares.

A new recipe is one class and one row of `RECIPES`, or a class in a user's own package.
"""

from typing import Any

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

RECIPES: Registry[Any] = Registry(
    "recipe",
    "recipes",
    {
        "start": "retrieval.training.recipes.recipe:Start",
        "linear": "retrieval.training.recipes.recipe:Linear",
        "head": "retrieval.training.recipes.recipe:ContinuedHead",
    },
    error=ConfigError,
    base="retrieval.training.recipes.recipe:Recipe",
)
