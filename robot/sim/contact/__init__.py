"""Contact of a gel with a height map."""
