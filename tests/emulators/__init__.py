"""Emulated devices: programs based on the same facts as the drivers, but not on the drivers."""
