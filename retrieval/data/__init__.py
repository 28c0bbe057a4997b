"""Pictures, catalogues and recordings, prepared for the towers and the search."""
