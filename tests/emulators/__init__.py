"""Devices that are programs: written from the same facts as the drivers, but not from the drivers."""
