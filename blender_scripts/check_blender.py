"""Does Blender work here? Prints version and devices, or what to install (exit status 2)."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from datagen.blender.system_libraries import check_blender

if __name__ == "__main__":
    sys.exit(check_blender())
