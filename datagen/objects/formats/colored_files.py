"""Whether a mesh file brings colours along, told by its beginning: of several files of one object that one is drawn."""

import re
from pathlib import Path

__all__ = ["tells_colors"]

_HEAD_BYTES = 1 << 20  # headers, and the JSON of nearly every .glb
_LINE = re.IGNORECASE | re.MULTILINE
_GLTF = re.compile(rb'"(images|COLOR_0)"')
_PLY = re.compile(rb"^(property .* (red|diffuse_red)|comment +texturefile)\b", _LINE)
_OBJ_LIBRARY = re.compile(rb"^[ \t]*mtllib\b", _LINE)
_OBJ_COLORS = re.compile(rb"^[ \t]*v([ \t]+[-+.\deE]+){6,7}[ \t]*\r?$", re.MULTILINE)


def tells_colors(path: Path) -> bool:
    """True for a texture, vertex colours or (of OBJ) a library of materials; False also where it cannot be read."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return False
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return _GLTF.search(head) is not None
    if suffix == ".ply":
        return _PLY.search(head.partition(b"end_header")[0]) is not None
    if suffix == ".obj":
        return _OBJ_LIBRARY.search(head) is not None or _OBJ_COLORS.search(head) is not None
    return False
