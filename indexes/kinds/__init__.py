"""Vector indexes: the base class, exact search in numpy, and the FAISS kinds."""
