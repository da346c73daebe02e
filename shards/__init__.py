"""The format of the dataset and the meaning of every number in it; see README.md.

This module imports nothing, so that `shards.geometry` costs NumPy alone. Start at
`shards.reader.open_dataset`.
"""
