"""From a folder of photos to an index."""
