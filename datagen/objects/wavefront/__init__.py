"""Wavefront OBJ and MTL, as they are written and not only as they are specified."""
