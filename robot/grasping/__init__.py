"""One attempt at a grasp. It uses devices only through their base classes."""
