"""Programs that measure this project and write its reference pages; not installed.

Each file is a program that runs in a checkout of the repository; its `--help` states what it measures. No program
asserts a time. The arms of a ratio run in turn, so that a busy machine slows all of them.
"""
