"""From a decoder's voxels to a closed coloured mesh, its files and its images. NumPy; no networks."""
