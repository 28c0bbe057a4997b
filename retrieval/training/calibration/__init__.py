"""Calibration of a checkpoint on touches of objects that it was not fitted to."""
