"""What the commands do: plan a dataset, render one motion, render one shard."""
