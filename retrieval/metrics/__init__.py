"""Measures of rankings and probabilities, with intervals, in numpy alone."""
