"""Localise the object on the table in a depth picture, and calibrate the camera."""
