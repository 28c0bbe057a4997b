"""Train checkpoints on recordings."""
