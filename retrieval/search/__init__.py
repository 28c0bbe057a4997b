"""From photos to an index, and from gel images to ranked objects."""
