"""How good a ranking is, with intervals and the level of chance."""

SCHEMA_VERSION = 2
"""Of results.json."""
