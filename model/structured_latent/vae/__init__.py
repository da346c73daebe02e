"""The VAE of structured latents: encoder, surface decoder, loss."""
