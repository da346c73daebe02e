"""The `datagen` command: parse, call, print."""
