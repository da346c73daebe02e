"""Render the images of one scene file: python blender_scripts/render_scene.py --help"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from datagen.blender.command import main

if __name__ == "__main__":
    main(sys.argv[1:])
