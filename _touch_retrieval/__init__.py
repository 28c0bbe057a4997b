"""Private helpers shared by `indexes`, `robot` and `retrieval`. They need the standard library and msgspec."""
