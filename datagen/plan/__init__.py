"""Which motion goes into which shard, and which motions are worth drawing."""
