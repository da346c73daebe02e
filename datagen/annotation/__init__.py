"""Exact labels of rendered scenes by ray casting, and the shard rows they go into."""
