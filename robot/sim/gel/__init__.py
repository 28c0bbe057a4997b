"""The simulated gel sensor: it turns a displacement map into its camera's picture."""
