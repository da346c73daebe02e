"""`python -m datagen.blender`: the child process that renders one Scene."""

import sys

from datagen.blender.system_libraries import blender_import_problem

if __name__ == "__main__":
    problem = blender_import_problem()
    if problem is not None:
        sys.stderr.write(f"{problem}\n")
        sys.exit(2)  # what the caller can mend
    from datagen.blender.command import main

    main(sys.argv[1:])
