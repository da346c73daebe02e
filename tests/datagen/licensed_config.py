"""Configurations of recorded motions on generated files of the published layouts."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml

from datagen.config import config_as_yaml, read_config
from datagen.grasps.config import GraspConfig
from datagen.grasps.synthesis.synthesise import synthesise_grasp
from datagen.hands.model import HandModel, shape_hand
from datagen.objects.asset.object_asset import ConvexPart
from datagen.objects.mesh.registration import REFERENCE_REGISTRATION
from datagen.objects.stores.graspxl_objects import GraspXLObjects
from datagen.objects.stores.library import REFERENCE_READING
from datagen.objects.watertight.preparation import REFERENCE_PREPARATION
from tests.datagen.grasps.recorded.official_files import recorded_arrays, still_arrays, write_sequence
from tests.datagen.objects.official_files import (
    MODELS,
    objaverse_id,
    write_graspxl_objects,
    write_objaverse_store,
)

ROOT = Path(__file__).resolve().parents[2]
IDS = tuple(objaverse_id(model) for model in MODELS)


def write_inputs(folder: Path, *, sequences: int = 2) -> None:
    """`folder`/graspxl with meshes and motions of three objects, `folder`/store with their originals."""
    write_graspxl_objects(folder / "graspxl")
    write_objaverse_store(folder / "store")
    for uid in IDS:
        for number in range(1, sequences + 1):
            write_sequence(folder / "graspxl", "mano_dataset_1", "large", uid, number, still_arrays(uid))


def write_config(folder: Path, change: Callable[[dict[str, Any]], object] | None = None) -> Path:
    """The preset graspxl on the inputs in `folder`, after `change` has had its way."""
    config = yaml.safe_load(config_as_yaml(read_config("graspxl")))
    config["motions"]["graspxl_root"] = str(folder / "graspxl")
    config["objects"] |= {"objaverse_root": str(folder / "store"), "cache_dir": str(folder / "cache")}
    config["hand"] |= {"model": "open", "skin": "open"}
    if change is not None:
        change(config)
    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def write_grasped_motion(folder: Path, model: HandModel, uid: str, grasp: GraspConfig) -> None:
    """`folder`/graspxl gets one motion in which `model`, simulated, really grasps and lifts the object."""
    library = GraspXLObjects(
        folder / "graspxl",
        None,
        textures="none",
        reading=REFERENCE_READING,
        preparation=REFERENCE_PREPARATION,
        registration=REFERENCE_REGISTRATION,
        cache_dir=folder / "cache",
    )
    asset = library.load(f"objaverse/{uid}@large")
    hull = trimesh.Trimesh(asset.watertight.verts_obj, asset.watertight.faces).convex_hull
    part = ConvexPart(verts_obj=np.asarray(hull.vertices), faces=np.asarray(hull.faces))
    simulated = replace(asset, watertight=replace(asset.watertight, parts=(part,)))
    hand = shape_hand(model, np.zeros(model.shapedirs.shape[2]))
    sequence = synthesise_grasp(hand, simulated, grasp, np.random.default_rng(0)).sequence
    assert sequence is not None
    in_file = replace(sequence, T_world_from_obj=sequence.T_world_from_obj @ asset.T_obj_from_file)
    write_sequence(
        folder / "graspxl", "mano_dataset_1", "large", uid, 1, recorded_arrays(in_file, model, uid)
    )
