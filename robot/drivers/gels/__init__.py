"""Gel sensors."""
