"""The command line `retrieve`. One file per command: its options, its action and its output."""
