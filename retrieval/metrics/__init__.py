"""Measures of rankings and probabilities, with confidence intervals, in numpy alone."""
