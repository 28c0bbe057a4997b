"""The command line `retrieve`."""
