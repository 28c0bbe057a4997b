"""Inputs as people have them: from cameras, shops, spreadsheets, network drives and other programs.

A case is a folder with a `case.py`: its docstring says in a sentence what must be true, and its function `check` makes
it sure. Files next to it, such as a table of a spreadsheet, are the case's input. `test_cases` runs all of them.
"""
