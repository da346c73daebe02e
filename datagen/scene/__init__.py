"""Scene: everything that decides the images of one motion, and its file."""
