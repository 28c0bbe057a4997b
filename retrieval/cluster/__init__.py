"""Catalogues on several machines: Ray embeds them and holds their shards. Extra `cluster`."""
