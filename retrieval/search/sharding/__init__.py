"""Indexes in several shards, in a folder or in an object store."""
