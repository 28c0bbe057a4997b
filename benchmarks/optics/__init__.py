"""Gel optics fitted to real presses, and evaluated on held-out presses."""
