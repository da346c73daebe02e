"""From a decoder's voxels to a watertight coloured mesh, its files and its images. NumPy; no networks."""
