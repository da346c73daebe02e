"""Files of GraspXL's published layout, made from motions of our own: nothing licensed is needed."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from datagen.grasps.sequence import GraspSequence
from datagen.hands.model import HandModel
from datagen.objects.mesh.object_mesh import ObjectMesh

START = np.array([1.0, 0.0, 0.5])  # GraspXL's table top under every object


def recorded_arrays(sequence: GraspSequence, model: HandModel, object_id: str) -> dict[str, Any]:
    """The dictionary that GraspXL's npy files hold. Angles become offsets from the model's mean pose."""
    mean = model.hands_mean if sequence.flat_hand_mean else 0.0
    n_frames = len(sequence.hand_pose)
    R = Rotation.from_matrix(sequence.T_world_from_obj[:, :3, :3])
    arrays = {
        "right_hand": {
            "trans": sequence.hand_translation_world + START,
            "rot": sequence.hand_orientation_world,
            "pose": sequence.hand_pose - mean,
        },
        object_id: {
            "trans": sequence.T_world_from_obj[:, :3, 3] + START,
            "rot": R.as_rotvec(),
            "angle": np.zeros((n_frames, 1)),
        },
    }
    return {owner: {k: v.astype(np.float32) for k, v in table.items()} for owner, table in arrays.items()}


def write_sequence(root: Path, part: str, size: str, object_id: str, number: int, content: Any) -> Path:
    path = root / part / size / object_id / f"mano_{number}.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, np.array(content, dtype=object), allow_pickle=True)
    return path


def write_object(root: Path, size: str, object_id: str, mesh: ObjectMesh) -> Path:
    """An OBJ without texture, in the object's own frame."""
    path = root / "object_dataset" / size / object_id / f"{object_id}.obj"
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in mesh.verts_obj]
    lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    path.write_text("\n".join(lines) + "\n")
    return path


def still_arrays(object_id: str, n_frames: int = 155, *, rise_m: float = 0.2) -> dict[str, Any]:
    """A motion without meaning: everything rises together over the last 25 frames."""
    rise = np.zeros((n_frames, 3), dtype=np.float32)
    rise[:, 2] = rise_m * np.clip((np.arange(n_frames) - n_frames + 26) / 25, 0.0, 1.0)
    zeros = np.zeros((n_frames, 3), dtype=np.float32)
    start = START.astype(np.float32) + np.array([0.0, 0.0, 0.05], np.float32)
    return {
        "right_hand": {
            "trans": rise + start,
            "rot": zeros.copy(),
            "pose": np.zeros((n_frames, 45), dtype=np.float32),
        },
        object_id: {
            "trans": rise + start,
            "rot": zeros.copy(),
            "angle": np.zeros((n_frames, 1), dtype=np.float32),
        },
    }
