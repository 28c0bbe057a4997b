"""The WSG-50 parallel gripper (Weiss Robotics, SCHUNK)."""
