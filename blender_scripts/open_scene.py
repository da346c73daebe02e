"""Open a scene file in Blender's window: blender --python blender_scripts/open_scene.py -- scene.npz

Blender brings its own Python 3.11; the packages it lacks come from the project's .venv.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
sys.path += [str(path) for path in (ROOT / ".venv").glob("lib/python3.11/site-packages")]

from datagen.blender.window import open_in_window
from datagen.scene.scene_file import load_scene

if __name__ == "__main__":
    open_in_window(load_scene(Path(sys.argv[sys.argv.index("--") + 1])))
