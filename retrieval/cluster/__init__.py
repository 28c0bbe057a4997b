"""Catalogues on several machines with Ray: building and serving. Extra `cluster`."""
