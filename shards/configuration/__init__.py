"""Configurations of `datagen` and `model`: found by name, merged by `extends`. Readers of shards need none of it."""
