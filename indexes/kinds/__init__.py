"""Vector indexes: their contract, the exact one, and those of FAISS."""
