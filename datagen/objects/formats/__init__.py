"""Mesh files in, GLB out."""
