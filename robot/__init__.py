"""Rigs and what they write: the recording format and importers of public data. Knows nothing of torch or faiss."""
