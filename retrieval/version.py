"""The version of touch-retrieval."""

__version__ = "0.1.0"
