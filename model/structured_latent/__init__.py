"""Stage 2: structured latents on the occupied voxels, their VAE and their flow."""
