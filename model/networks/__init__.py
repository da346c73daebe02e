"""Layers shared by the networks of both stages; parameter names are those of TRELLIS (FORMATS 4.1)."""
