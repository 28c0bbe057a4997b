"""Adaptation of a matcher to a new sensor and a few own objects, with an accuracy estimate."""
