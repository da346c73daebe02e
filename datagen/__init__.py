"""The generator: grasp sequences, scenes, Blender, annotation, shards; see README.md."""
