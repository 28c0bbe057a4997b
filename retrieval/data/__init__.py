"""Pictures, catalogues and recordings, as towers and searches want them."""
