"""Gels and cameras on USB."""
