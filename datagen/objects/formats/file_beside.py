"""Files that a mesh file names: found where exporters put them, never outside of the mesh's folder."""

import unicodedata
from pathlib import Path, PurePosixPath

__all__ = ["file_beside"]


def file_beside(mesh_path: Path, name: str) -> Path | None:
    """The file called `name` in the folder of `mesh_path`; None where there is none.

    Tried as it is written, then its last part beside the mesh (paths of another machine), each also
    in another case where that is unique. A file that lies outside of the folder, as links may, is
    none.
    """
    written = PurePosixPath(name.strip().strip("\"'").replace("\\", "/"))
    folder = mesh_path.parent
    for parts in (written.parts, written.parts[-1:]):
        try:
            found = _descend(folder, parts)
            if found is not None and found.is_file() and found.resolve().is_relative_to(folder.resolve()):
                return found
        except OSError:  # a name too long, a loop of links, a folder that cannot be listed
            continue
    return None


def _descend(folder: Path, parts: tuple[str, ...]) -> Path | None:
    at = folder
    for part in parts:
        if "\0" in part or part.startswith("/") or part.endswith(":"):  # an absolute path
            return None
        if not (at / part).exists():
            wanted = _folded(part)
            alike = [entry for entry in at.iterdir() if _folded(entry.name) == wanted] if at.is_dir() else []
            if len(alike) != 1:
                return None
            at = alike[0]
        else:
            at = at / part
    return at


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()
