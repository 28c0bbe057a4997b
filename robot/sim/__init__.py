"""The simulated rig: objects, contact, gel optics and camera behind the rig contract."""
