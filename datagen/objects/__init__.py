"""Object libraries and all that the generator needs to know of one object."""
