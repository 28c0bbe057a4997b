"""Vector indexes: the base class, FAISS, and the measurement of recall and time."""
