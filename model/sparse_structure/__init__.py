"""Stage 1: voxel autoencoder and the dual-branch flow that denoises voxels and amodal masks together."""
