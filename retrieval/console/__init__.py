"""Shared parts of all commands: terminal output, output files, progress, and Ctrl-C."""
