"""Materials and textures: skin, sleeve, table tops, the held object."""
