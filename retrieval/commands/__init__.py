"""The command line `retrieve`: one file a command, with its options, what it does and what it prints."""
