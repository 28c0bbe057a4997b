"""The matcher: towers, fusion head and checkpoint, and the encoding of touches and photos."""
