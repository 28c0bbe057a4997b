"""Results for people: a query's table and page, the report of an evaluation, and that of the frontier.

Nothing is imported here: a query's table should not pay for plots.
"""
