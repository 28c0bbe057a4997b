"""Cameras that never wait, and what is cut out of their pictures."""
