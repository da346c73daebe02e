"""ObjectAsset, one object ready for grasps and rendering, and its mirror image."""
