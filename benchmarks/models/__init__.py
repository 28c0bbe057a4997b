"""What makes the shipped models, and what says how good they are."""
