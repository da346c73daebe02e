"""Which files of a folder are one object, told by their names alone, and which of them comes first.

What is published in several files per object names them in a few ways:

    003_cracker_box/google_16k/textured.obj, .../nontextured.stl, .../poisson/textured.obj    YCB
    models/obj_000001.ply, models_eval/obj_000001.ply                                         BOP
    <32 hex digits>.glb, obj/<32 hex digits>.obj, <32 hex digits>/model.obj                   from Objaverse
    mug.obj, mug.stl; obj/mug.obj, stl/mug.stl                                                anything
"""

import os
import re
import unicodedata
from pathlib import PurePosixPath

from shards.splits import identity_and_variant

__all__ = ["drawn_uid", "layout_rank", "object_uid_of_file", "variant_of"]

# Folders of one YCB object, what is drawn first: the field's own choice, finer scans, then the other reconstructions.
_YCB_FOLDERS = ("google_16k", "google_64k", "google_512k", "tsdf", "poisson", "clouds")
# Files of one object that lie in a folder named after it.
_YCB_STEMS = ("textured", "textured_simple", "textured_reoriented", "nontextured")
_MODEL_STEMS = (*_YCB_STEMS, "model", "mesh", "object", "scene", "model_normalized", "model_simplified")
_BOP_FOLDERS = ("models", "models_reconst", "models_fine", "models_cad", "models_eval")
_BOP_FOLDER = re.compile(r"(object_)?(models(_[a-z0-9]+)?)")
_BOP_STEM = re.compile(r"obj_\d{6}")
_OBJAVERSE_ID = re.compile(r"(?<![0-9a-zA-Z])[0-9a-f]{32}(?![0-9a-zA-Z])")
_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")  # what tells more about a surface comes first


def object_uid_of_file(place: str, folder: str) -> str:
    """The uid of the object that the mesh file `place` (relative to a folder, "/" between parts) shows.

    "folder/<path>" without suffix and without what only tells files of one object apart; of a model
    from Objaverse "objaverse/<uid>", as in the store itself, so that both fall into one split.
    `folder` is the name of the folder: it stands for an object whose files lie in it directly.
    """
    path = PurePosixPath(place)
    stem, parents = path.stem, list(path.parent.parts)
    if parents and f".{parents[-1].casefold()}" == path.suffix.casefold():
        parents.pop()
    objaverse = _objaverse_id(stem, parents)
    if objaverse is not None:
        return f"objaverse/{objaverse}"
    if parents and parents[-1].casefold() in _YCB_FOLDERS and _is_ycb(stem, parents):
        names = parents[:-1]
    elif stem.casefold() in _YCB_STEMS:
        names = parents
    elif parents and _BOP_FOLDER.fullmatch(parents[-1].casefold()) and _BOP_STEM.fullmatch(stem):
        names = [*parents[:-1], stem]
    else:
        names = [*parents, stem]
    *above, last = names or [folder]
    return "/".join(("folder", *map(_uid_part, above), _uid_part(last).replace("@", "%40")))


def layout_rank(place: str) -> tuple[int, int, int, str]:
    """Sorts the files of one object, all else being equal: textured before not, by folder, by format, by name."""
    path = PurePosixPath(place)
    folder = path.parent.name.casefold()
    bop = _BOP_FOLDER.fullmatch(folder)
    folders = _BOP_FOLDERS if bop else _YCB_FOLDERS
    name = str(bop[2]) if bop else folder
    return (
        int("nontextured" in path.stem.casefold()),
        folders.index(name) if name in folders else len(folders),
        _SUFFIXES.index(path.suffix.casefold()),
        place,
    )


def variant_of(identity: str, uid: str) -> str:
    """The uid of an object of a folder that counts as a variant of the object `identity`: "folder/a@folder%2Fb"."""
    # A slash would begin a name, and "-mirrored" at the end of a variant means the mirror image.
    return f"{identity}@{uid.replace('/', '%2F').replace('-mirrored', '%2Dmirrored')}"


def drawn_uid(uid: str) -> str:
    """The object that is drawn under a uid of `variant_of`; any other uid as it is."""
    _, variant = identity_and_variant(uid)
    if "%2F" not in variant:
        return uid
    return variant[1:].replace("%2F", "/").replace("%2Dmirrored", "-mirrored")


def _is_ycb(stem: str, parents: list[str]) -> bool:
    """Whether a file in a folder that YCB has is one of YCB's: some of the folders have common names."""
    named_after_object = parents[-2:-1] == [stem]
    return named_after_object or stem.casefold() in (*_YCB_STEMS, "merged_cloud")


def _objaverse_id(stem: str, parents: list[str]) -> str | None:
    """The 32 digits of a derived file's name, or of its folder where the name says nothing."""
    found = _OBJAVERSE_ID.search(stem)
    if found is None and parents and stem.casefold() in _MODEL_STEMS:
        found = _OBJAVERSE_ID.fullmatch(parents[-1])
    return None if found is None else found[0]


def _uid_part(name: str) -> str:
    """A part of a uid: the same for composed and decomposed letters; what is no text is written as in a URL."""
    text = unicodedata.normalize("NFC", name).replace("%", "%25")
    return "".join(
        character if character.isprintable() else "".join(f"%{byte:02X}" for byte in os.fsencode(character))
        for character in text
    )
