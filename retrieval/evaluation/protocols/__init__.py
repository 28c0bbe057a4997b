"""Benchmark protocols: a file for each data set."""
