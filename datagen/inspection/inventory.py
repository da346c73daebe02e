"""Every open and licensed input of the generator: is it there, is it sound, where does it belong."""

import hashlib
import importlib.metadata
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Literal

from datagen.config import DatasetConfig
from datagen.grasps.recorded.graspxl import LICENCE as GRASPXL_LICENCE
from datagen.grasps.recorded.graspxl import SIZES, find_sequences
from datagen.hands.html_skin import find_html, load_html_skin
from datagen.hands.mano import find_mano, load_mano
from datagen.input_error import InputError
from datagen.objects.stores.graspxl_objects import GraspXLObjects
from datagen.objects.stores.library import StarterPack
from datagen.objects.stores.objaverse import ObjaverseStore, objaverse_root
from datagen.objects.stores.sweethome3d import find_libraries
from datagen.sources.hands import html_dir, mano_dir
from datagen.sources.motions import graspxl_root

__all__ = ["AssetState", "asset_states"]

_MANO_LICENCE = "MANO licence: non-commercial research, no redistribution"
_HTML_LICENCE = "HTML licence: non-commercial research, no redistribution"
_NOWHERE = "nowhere yet"


@dataclass(frozen=True, kw_only=True)
class AssetState:
    """One input. `problem` is set when it is there but cannot be used."""

    name: str
    state: Literal["present", "missing", "wrong"]
    version: str
    licence: str
    place: str  # where it lies, or must lie
    setting: str  # configuration key and environment variable that name the place
    how_to_get: str
    problem: str = ""


def asset_states(config: DatasetConfig) -> tuple[AssetState, ...]:
    """The open inputs first, then the licensed ones. Licensed files are opened and checked, not only found."""
    return (
        _open_hand(),
        _open_skin(),
        _starter_pack(),
        _hdris(),
        _sweethome3d(config),
        _mano(config, "right"),
        _mano(config, "left"),
        _html(config),
        _graspxl_motions(config),
        _graspxl_objects(config),
        _objaverse(config),
    )


def _packaged(name: str, licence: str, path: Path, note: str) -> AssetState:
    return AssetState(
        name=name,
        state="present" if path.is_file() else "missing",
        version=_digest(path) if path.is_file() else "",
        licence=licence,
        place=str(path),
        setting=note,
        how_to_get="part of this package",
    )


def _open_hand() -> AssetState:
    path = Path(str(files("datagen.hands") / "data" / "open_hand.npz"))
    return _packaged("open hand", "CC0-1.0", path, "hand.model: open")


def _open_skin() -> AssetState:
    path = Path(str(files("datagen.hands") / "data" / "skin" / "skin.json"))
    return _packaged("open skins", "CC0-1.0, BSD-3-Clause (NOTICE)", path, "hand.skin: open")


def _starter_pack() -> AssetState:
    path = Path(str(files("datagen.objects") / "data" / "starter_pack.zip"))
    state = _packaged("starter objects", "CC0-1.0", path, "objects.source: starter")
    if state.state == "missing":
        return state
    return _checked(state, lambda: f"{len(StarterPack().uids())} objects, {state.version}")


def _hdris() -> AssetState:
    spec = importlib.util.find_spec("bpy")
    folder = None if spec is None or spec.origin is None else Path(spec.origin).parent
    hdris = sorted(folder.glob("*/datafiles/studiolights/world/*.exr")) if folder is not None else []
    return AssetState(
        name="HDRIs",
        state="present" if hdris else "missing",
        version=f"{len(hdris)} images of bpy {importlib.metadata.version('bpy')}" if hdris else "",
        licence="CC0-1.0 (Poly Haven)",
        place=str(hdris[0].parent) if hdris else _NOWHERE,
        setting="sampling.lights.hdris",
        how_to_get="pip install 'forehoi-open[datagen]' brings Blender's module, which holds them",
    )


def _sweethome3d(config: DatasetConfig) -> AssetState:
    path = config.objects.path if config.objects.source == "sweethome3d" else None
    missing = AssetState(
        name="Sweet Home 3D models",
        state="missing",
        version="",
        licence="CC0-1.0, CC-BY and others, object by object",
        place=str(path or "/usr/share/sweethome3d"),
        setting="objects.source: sweethome3d, objects.path",
        how_to_get="apt-get install sweethome3d-furniture",
    )
    try:
        libraries = find_libraries(path)
    except InputError:
        return missing
    return _found(missing, f"{len(libraries)} libraries", libraries[0].parent)


def _mano(config: DatasetConfig, side: Literal["right", "left"]) -> AssetState:
    folder = mano_dir(config.hand)
    file_name = f"MANO_{side.upper()}.pkl"
    missing = AssetState(
        name=f"MANO hand, {side}",
        state="missing",
        version="",
        licence=_MANO_LICENCE,
        place=_NOWHERE if folder is None else str(folder / file_name),
        setting="hand.mano_dir, MANO_DIR",
        how_to_get=f"register at mano.is.tue.mpg.de, download 'Models & Code', unpack {file_name}"
        + (
            ""
            if side == "right"
            else " (left hands are drawn as mirrored right ones; this file is only checked)"
        ),
    )
    path = None if folder is None else find_mano(folder, side)
    if path is None:
        return missing
    state = _found(missing, _digest(path), path)
    return _checked(state, lambda: f"{len(load_mano(path, side).v_template)} vertices, {state.version}")


def _html(config: DatasetConfig) -> AssetState:
    folder, hands = html_dir(config.hand), mano_dir(config.hand)
    missing = AssetState(
        name="HTML skin texture",
        state="missing",
        version="",
        licence=_HTML_LICENCE,
        place=_NOWHERE if folder is None else str(folder / "TextureBasis"),
        setting="hand.html_dir, HTML_DIR",
        how_to_get="request it at handtracker.mpi-inf.mpg.de/projects/HandTextureModel, unpack TextureBasis",
    )
    basis_folder = None if folder is None else find_html(folder)
    if folder is None or basis_folder is None:
        return missing
    state = _found(missing, "", basis_folder)
    if hands is None or find_mano(hands, "right") is None:
        return _wrong(state, "found, but it needs MANO_RIGHT.pkl, on whose triangles it lies")

    def version() -> str:
        basis = load_html_skin(folder, load_mano(hands, "right")).basis
        return f"{basis.basis.shape[1]} coefficients, {basis.size} px"

    return _checked(state, version)


def _graspxl_motions(config: DatasetConfig) -> AssetState:
    def version(root: Path) -> str:
        found = find_sequences(root, SIZES)
        parts, objects = {file.part for file in found}, {file.object_uid for file in found}
        return f"{len(found):,} sequences of {len(objects):,} objects in {', '.join(sorted(parts))}"

    archives = "mano_dataset_1..3.zip; a sample is its dataset_example"
    return _graspxl(config, "GraspXL motions", archives, version)


def _graspxl_objects(config: DatasetConfig) -> AssetState:
    def version(root: Path) -> str:
        library = GraspXLObjects(
            root,
            None,
            textures="none",
            registration=config.objects.registration,
            reading=config.objects.reading,
            preparation=config.objects.preparation,
            cache_dir=Path(),
        )
        return f"{len(library.uids()):,} meshes"

    return _graspxl(config, "GraspXL objects", "object_dataset.zip", version)


def _graspxl(config: DatasetConfig, name: str, archives: str, version: Callable[[Path], str]) -> AssetState:
    """One of the two halves of GraspXL, which lie in one folder."""
    missing = AssetState(
        name=name,
        state="missing",
        version="",
        licence=GRASPXL_LICENCE,
        place=_NOWHERE,
        setting="motions.graspxl_root, GRASPXL",
        how_to_get=f"form at github.com/zdchan/GraspXL: {archives}",
    )
    try:
        root = graspxl_root(config.motions.graspxl_root)
    except InputError:
        return missing
    if not root.is_dir():
        return replace(missing, place=str(root))
    return _checked(_found(missing, "", root), lambda: version(root))


def _objaverse(config: DatasetConfig) -> AssetState:
    objects = config.objects
    root = objaverse_root(objects.objaverse_root)
    missing = AssetState(
        name="Objaverse 1.0",
        state="missing",
        version="",
        licence="ODC-By (collection); each object its own",
        place=str(root),
        setting="objects.objaverse_root, OBJAVERSE",
        how_to_get="pip install objaverse; objaverse.load_objects(uids) fills this folder",
    )
    if not root.is_dir():
        return missing
    state = _found(missing, "", root)
    return _checked(
        state,
        lambda: f"{len(ObjaverseStore(root, objects.reading, objects.preparation, Path()).uids()):,} objects",
    )


def _found(state: AssetState, version: str, place: Path) -> AssetState:
    return replace(state, state="present", version=version, place=str(place))


def _wrong(state: AssetState, problem: str) -> AssetState:
    return replace(state, state="wrong", problem=problem)


def _checked(state: AssetState, version: Callable[[], str]) -> AssetState:
    """The state with what opening the input tells, or with what is wrong with it."""
    try:
        return replace(state, version=version())
    except InputError as error:
        return _wrong(state, str(error))


def _digest(path: Path) -> str:
    return f"sha256 {hashlib.sha256(path.read_bytes()).hexdigest()[:12]}"
