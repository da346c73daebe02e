"""Does Blender work here? Prints version and devices, or what to install (exit status 2)."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from datagen.blender.system_libraries import blender_import_problem


def main() -> int:
    problem = blender_import_problem()
    if problem is not None:
        sys.stderr.write(f"{problem}\n")
        return 2
    import bpy

    from datagen.blender.devices import found_devices

    sys.stdout.write(f"bpy {bpy.app.version_string}\n")
    for backend, names in found_devices().items():
        sys.stdout.write(f"{backend.lower()}: {', '.join(names)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
