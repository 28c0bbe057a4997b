"""Programs that measure this project and write its reference pages; not installed.

Each runs in a checkout of the repository, `python -m benchmarks.NAME`; its `--help` states what it measures. No program
asserts a time. The arms of a ratio run in turn, so that a busy machine slows all of them.
"""
