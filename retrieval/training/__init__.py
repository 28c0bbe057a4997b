"""Fitting of matchers: recipes, trainings, and calibrations."""
