"""Results for people: the table and page of a query, and the reports of evaluations and benchmarks.

The package imports nothing here, so that the table of a query does not import plotting libraries.
"""
