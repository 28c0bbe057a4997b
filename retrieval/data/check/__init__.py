"""Checks of a recording: broken files, copies, swapped folders, leakage."""
