"""The index on disk: a folder of generations, of which one is current."""
