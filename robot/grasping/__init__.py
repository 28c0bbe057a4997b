"""One attempt at a grasp, over the contract of devices alone."""
