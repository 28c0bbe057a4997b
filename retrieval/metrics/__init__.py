"""Measures of rankings and probabilities, with confidence intervals; they need only numpy."""
