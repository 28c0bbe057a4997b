"""Private helpers shared by `indexes`, `robot` and `retrieval`. Standard library only."""
