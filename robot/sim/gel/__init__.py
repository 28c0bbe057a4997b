"""The simulated gel sensor: a displacement map in, its camera's picture out."""
