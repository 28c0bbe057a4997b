"""The index on disk: a folder of generations, one of them current."""
