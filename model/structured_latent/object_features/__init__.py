"""What the SLat encoder reads of an object: features on its active voxels."""
