"""What the commands of `datagen` and `model` share; readers of shards need none of it."""
