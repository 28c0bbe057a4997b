"""Drivers of real devices. Each file imports what it needs beyond the package only when it connects."""
