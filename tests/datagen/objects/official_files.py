"""Files laid out as Objaverse and GraspXL publish them, made from the starter pack."""

import gzip
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import fast_simplification
import numpy as np

from datagen.objects.asset.object_asset import ObjectAsset
from datagen.objects.formats.glb_export import mesh_to_glb
from datagen.objects.mesh.graspable_size import scaled_mesh
from datagen.objects.stores.library import StarterPack

# Small textured starter objects whose watertight meshes are their own surfaces.
MODELS = ("starter/bread", "starter/rock_a", "starter/stone_lantern")
GRASPXL_FACES = 3000
# Smallest bbox side of each set; "large" as measured on the published examples, the others made up.
SMALLEST_SIDE_M = {"small": 0.035, "medium": 0.055, "large": 0.075}


@dataclass(frozen=True, kw_only=True)
class Copy:
    """A GraspXL-like copy of an object: x_copy = T_copy_from_object @ x_object."""

    verts: np.ndarray
    faces: np.ndarray
    T_copy_from_object: np.ndarray


def objaverse_id(starter_uid: str) -> str:
    """32 hex digits that stand for a starter object."""
    return hashlib.md5(starter_uid.encode()).hexdigest()


def folder_of(model: int) -> str:
    """Models alternate between two folders."""
    return f"000-{model % 2:03d}"


def record(starter_uid: str, asset: ObjectAsset) -> dict:
    """A metadata record with the keys of Sketchfab's API that Objaverse keeps."""
    uid = objaverse_id(starter_uid)
    return {
        "uid": uid,
        "uri": f"https://api.sketchfab.com/v3/models/{uid}",
        "viewerUrl": f"https://sketchfab.com/3d-models/{uid}",
        "name": asset.name,
        "license": "by",
        "user": {"username": "ann", "displayName": "Ann Modeller", "profileUrl": "https://sketchfab.com/ann"},
        "animationCount": 0,
        "faceCount": len(asset.mesh.faces),
        "vertexCount": len(asset.mesh.verts_obj),
        "isAgeRestricted": False,
        "archives": {"glb": {"textureCount": 1, "textureMaxResolution": 512, "size": 1}},
    }


def write_gz(path: Path, content: object) -> None:
    """Gzipped JSON, folders made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(json.dumps(content).encode()))


def write_objaverse_store(
    root: Path,
    models: Sequence[str] = MODELS,
    *,
    metadata: bool = True,
    licences: Sequence[str] = ("by", "cc0"),
    file_scale: float = 10.0,
) -> Path:
    """A store as the Python package `objaverse` leaves it: GLBs (and metadata) of starter objects.

    Model k is in folder 000-00(k mod 2) under `objaverse_id(models[k])`, `file_scale` times as large
    as the starter object, with licence slug licences[k mod len]. Gives `root` back.
    """
    pack = StarterPack()
    records: dict[str, dict] = {}
    paths: dict[str, str] = {}
    lvis: dict[str, list[str]] = {}
    for k, starter_uid in enumerate(models):
        asset, uid, folder = pack.load(starter_uid), objaverse_id(starter_uid), folder_of(k)
        path = root / "glbs" / folder / f"{uid}.glb"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(mesh_to_glb(scaled_mesh(asset.mesh, file_scale)))
        licence = licences[k % len(licences)]
        records.setdefault(folder, {})[uid] = {**record(starter_uid, asset), "license": licence}
        paths[uid] = f"glbs/{folder}/{uid}.glb"
        lvis.setdefault(starter_uid.partition("/")[2], []).append(uid)
    if metadata:
        for folder, content in records.items():
            write_gz(root / "metadata" / f"{folder}.json.gz", content)
        write_gz(root / "object-paths.json.gz", paths)
        write_gz(root / "lvis-annotations.json.gz", lvis)
    return root


def graspxl_copy(
    asset: ObjectAsset, *, smallest_side_m: float = 0.075, turn: np.ndarray | None = None
) -> Copy:
    """The object closed, decimated, turned, scaled and centred, as GraspXL's meshes are."""
    rotation = np.eye(3) if turn is None else turn
    verts, faces = asset.watertight.verts_obj, asset.watertight.faces
    if len(faces) > GRASPXL_FACES:
        verts, faces = fast_simplification.simplify(
            verts.astype(np.float32), faces.astype(np.int32), target_count=GRASPXL_FACES, agg=5
        )
    turned = verts.astype(np.float64) @ rotation.T
    scale = smallest_side_m / np.ptp(turned, axis=0).min()
    center = 0.5 * scale * (turned.min(axis=0) + turned.max(axis=0))
    T_copy_from_object = np.eye(4)
    T_copy_from_object[:3, :3] = scale * rotation
    T_copy_from_object[:3, 3] = -center
    return Copy(
        verts=scale * turned - center, faces=faces.astype(np.int64), T_copy_from_object=T_copy_from_object
    )


def write_graspxl_objects(
    root: Path,
    models: Sequence[str] = MODELS,
    *,
    sizes: Sequence[str] = ("large",),
    turn: np.ndarray | None = None,
) -> Path:
    """object_dataset/<size>/<id>/<id>.obj below `root`, of the same objects and ids as the store.

    `turn` is the rotation from the Z-up turned model to the copy's axes. Gives `root` back.
    """
    pack = StarterPack()
    for starter_uid in models:
        asset, uid = pack.load(starter_uid), objaverse_id(starter_uid)
        for size in sizes:
            copy = graspxl_copy(asset, smallest_side_m=SMALLEST_SIDE_M[size], turn=turn)
            path = root / "object_dataset" / size / uid / f"{uid}.obj"
            path.parent.mkdir(parents=True, exist_ok=True)
            lines = [f"v {x:.8f} {y:.8f} {z:.8f}" for x, y, z in copy.verts]
            lines += [f"f {a} {b} {c}" for a, b, c in copy.faces + 1]
            path.write_text("\n".join(lines) + "\n")
    return root
