"""Measures of rankings and probabilities, with confidence intervals, only with numpy."""
