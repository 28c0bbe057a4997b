"""How good a ranking is, with intervals and the level of chance."""
