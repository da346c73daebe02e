"""A watertight surface for any mesh, and its convex parts."""
