"""Layers on the occupied voxels of a grid: cost and memory grow with voxels, not with the grid's volume."""
