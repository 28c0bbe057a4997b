"""Gel optics fitted to real presses, and judged on presses held out."""
