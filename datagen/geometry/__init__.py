"""Exact ray casting, shared by sampling and annotation."""
