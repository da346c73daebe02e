"""Where objects come from: the starter pack, folders, Sweet Home 3D, Objaverse, GraspXL."""
