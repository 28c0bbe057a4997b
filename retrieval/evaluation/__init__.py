"""Ranking metrics with confidence intervals and chance levels."""

SCHEMA_VERSION = 3
"""Schema version of results.json."""
