"""Cameras over the table."""
