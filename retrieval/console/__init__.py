"""What every command shares: where it speaks, what it writes, progress, and Ctrl-C."""
