"""Published checkpoints, mapped onto the modules of this package."""
