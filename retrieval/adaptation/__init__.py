"""Fitting a matcher to a new sensor and a few own objects, and saying what came of it."""
