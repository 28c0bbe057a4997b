"""The matcher: towers, fusion, its file, and what a touch or a photo becomes in it."""
