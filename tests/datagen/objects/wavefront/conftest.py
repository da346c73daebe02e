"""A folder of small files around one OBJ, and what is read from it."""

from collections.abc import Callable
from pathlib import Path

import pytest

from datagen.objects.mesh.file_mesh import FileMesh
from datagen.objects.wavefront.obj_file import read_obj

# A tetrahedron with legs of 0.1 along the axes; volume 0.1³ / 6.
VERTS = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\n"
FACES = "f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


@pytest.fixture
def tetrahedron() -> str:
    return VERTS + FACES


@pytest.fixture
def obj(tmp_path: Path) -> Callable[..., FileMesh]:
    """Reads "a.obj" after writing it and the other files; names may hold folders."""

    def read(text: str | bytes, *, max_file_mb: float = 1.0, **others: str | bytes) -> FileMesh:
        for name, content in {"a.obj": text, **others}.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_obj(tmp_path / "a.obj", max_file_mb=max_file_mb)

    return read
