"""Catalogues on several machines with Ray: building, serving and training. Extra `cluster`."""
