"""Checks of a recording: broken files, near copies, swapped folders, leakage."""
