"""Streams of free-running cameras, and the rectification of their pictures."""
