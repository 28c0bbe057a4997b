"""Adaptation of a matcher to a new sensor and a few of your objects, with an accuracy estimate."""
