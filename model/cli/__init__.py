"""The `forehoi` command: parse, call, print."""
