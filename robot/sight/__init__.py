"""From a picture with depth to where the object stands."""
