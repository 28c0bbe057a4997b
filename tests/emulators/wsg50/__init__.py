"""An emulated WSG-50."""
