"""The recording: a folder of grasps, and the log of every attempt."""
