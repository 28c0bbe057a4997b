"""Objects of the simulated rig: shape, relief, material and appearance."""
