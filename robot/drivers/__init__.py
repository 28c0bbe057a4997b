"""Drivers of real devices. A driver imports optional packages only when it connects."""
