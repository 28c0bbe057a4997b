"""From gel images to ranked objects."""
