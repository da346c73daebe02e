"""From images to a reconstruction with trained networks of both stages, and the files of one."""
