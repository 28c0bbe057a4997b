"""Trackers of experiments, by name: functions from the path of a checkpoint to a callback `on_step`."""

from typing import Any

from _touch_retrieval.registry import Registry
from retrieval.errors import ConfigError

TRACKERS: Registry[Any] = Registry("tracker", "trackers", {}, error=ConfigError)
"""Only users' packages register trackers."""
