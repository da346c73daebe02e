"""What must be true of every object, clip and frame. Pure functions from rows to problems."""

import hashlib
from collections.abc import Iterator

import numpy as np

from shards.array_types import Bool, Float
from shards.geometry import project_points, transform_points
from shards.reader import Frame, Frames
from shards.schema import ClipRow, FrameRow, ObjectRow
from shards.splits import SplitRule, split_of_object
from shards.storage.images import Geometry, Masks, mask_box_px

__all__ = ["clip_problems", "frame_problems", "object_problems"]

REPROJECTION_PX = 0.01
RIGID_TOLERANCE = 1e-5
DEPTH_TOLERANCE = 2.0**-14  # relative; twice the error of PXR24
NORMAL_TOLERANCE = 5e-3  # half floats
FRACTION_TOLERANCE = 1e-5
VOXEL = 1.0 / 64.0
SAMPLE_SHARE = 0.98  # of surface points and distance samples that must agree with the voxels

_SIGNATURES = {"png": b"\x89PNG", "jpeg": b"\xff\xd8\xff", "webp": b"RIFF"}


def object_problems(row: ObjectRow) -> list[str]:
    """Problems of one object: shapes, canonical frame, and voxels against surface and distance samples."""
    problems = []
    if not row.licence:
        problems.append("no licence")
    if row.mesh_glb is not None and hashlib.sha256(row.mesh_glb).hexdigest() != row.mesh_sha256:
        problems.append("mesh_glb does not match mesh_sha256")
    T = row.T_objmesh_from_canonical
    if not np.allclose(T[:3, :3], row.object_scale_m * np.eye(3)) or not np.array_equal(T[3], [0, 0, 0, 1]):
        problems.append("T_objmesh_from_canonical is not object_scale_m and a translation")
    if len(row.surface_points) == 0:
        problems.append("no surface points")
    elif np.abs(row.surface_points).max() > 0.5 + 1e-3:
        problems.append("surface points outside [-0.5, 0.5]")
    if not _all_unit(row.surface_normals):
        problems.append("surface normals are not unit vectors")
    return problems + list(_voxel_problems(row))


def clip_problems(clip: ClipRow, frames: Frames, split_rule: SplitRule | None) -> list[str]:
    """Problems of one clip: camera, split, numbering, and its metrics against its frames."""
    problems = []
    if split_rule is not None and (expected := split_of_object(clip.object_uid, split_rule)) != clip.split:
        problems.append(f"split: the rule says {expected} for object {clip.object_uid}, found {clip.split}")
    K = clip.K
    if not (0 < K[0, 2] < clip.image_width and 0 < K[1, 2] < clip.image_height):
        problems.append("principal point outside the image")
    if (
        min(K[0, 0], K[1, 1]) <= 0
        or K[0, 1] != 0
        or not np.array_equal(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1])
    ):
        problems.append("K is not a pinhole matrix without skew")
    if len(frames) != clip.n_frames or list(frames["frame_index"]) != list(range(len(frames))):
        problems.append(f"frames are not 0..{clip.n_frames - 1}")
    if not np.allclose(frames["time_s"], frames["frame_index"] / clip.fps, atol=1e-6):
        problems.append("time_s is not frame_index / fps")
    for name in ("object_visible_fraction", "hand_visible_fraction"):
        for statistic, value in (("min", frames[name].min()), ("mean", frames[name].mean())):
            if abs(getattr(clip, f"{name}_{statistic}") - value) > FRACTION_TOLERANCE:
                problems.append(f"{name}_{statistic} is not that of the frames")
    if clip.has_table != bool(np.isfinite(clip.table_top_z_m)):
        problems.append("has_table and table_top_z_m disagree")
    return problems + list(_margin_problems(clip, frames))


def frame_problems(frame: Frame, clip: ClipRow) -> list[str]:
    """Problems of one decoded frame."""
    row, masks, geometry = frame.row, frame.masks, frame.geometry
    size = (clip.image_height, clip.image_width)
    shapes = {
        frame.rgb.shape[:2],
        masks.hand_visible.shape,
        geometry.depth.shape,
        geometry.depth_object.shape,
    }
    if shapes != {size}:
        return [f"images of sizes {sorted(shapes)}, expected {size}"]
    problems = list(_mask_problems(masks))
    problems += _geometry_problems(geometry, masks)
    problems += _count_problems(row, masks)
    problems += _pose_problems(row, clip)
    if not row.rgb.startswith(_SIGNATURES[clip.rgb_codec]):
        problems.append(f"rgb is not {clip.rgb_codec}")
    return problems


def _margin_problems(clip: ClipRow, frames: Frames) -> Iterator[str]:
    """No amodal mask comes nearer to the border of the image than the vertices of what it shows.

    A pixel is in a mask when its centre is, half a pixel from its edge.
    """
    size = np.array([clip.image_width, clip.image_height])
    for name in ("hand", "object"):
        boxes = frames[f"{name}_box_amodal_px"].astype(np.float64)
        boxes = boxes[boxes[:, 0] >= 0]  # -1: empty
        nearest = np.minimum(boxes[:, :2], size - boxes[:, 2:]).min(initial=np.inf)
        if nearest < clip.min_margin_px - 0.5 - REPROJECTION_PX:
            yield (
                f"the amodal {name} comes to {nearest:.0f} px of the border, min_margin_px says "
                f"{clip.min_margin_px:.2f}"
            )


def _voxel_problems(row: ObjectRow) -> Iterator[str]:
    voxels = row.occupancy_64.astype(np.int64)
    if len(voxels) == 0:
        yield "occupancy_64 is empty"
        return
    if voxels.max() > 63:
        yield "occupancy_64 outside 0..63"
        return
    flat = voxels @ np.array([4096, 64, 1])
    if np.any(np.diff(flat) <= 0):
        yield "occupancy_64 is not sorted and unique"
    grid = np.zeros((66, 66, 66), bool)
    grid[tuple(voxels.T + 1)] = True
    near = _dilated(grid)
    if np.mean(near[_voxel_of(row.surface_points)]) < SAMPLE_SHARE:
        yield "occupancy_64 does not cover the surface points"
    outside = _reached_from_the_border(grid)
    enclosed = ~outside & ~grid
    in_cube = np.all(np.abs(row.sdf_points) <= 0.5, axis=1)
    deep, far = in_cube & (row.sdf_values < -2 * VOXEL), in_cube & (row.sdf_values > 2 * VOXEL)
    for name, chosen, expected in (("inside", deep, enclosed), ("outside", far, outside)):
        if np.any(chosen) and np.mean(expected[_voxel_of(row.sdf_points[chosen])]) < SAMPLE_SHARE:
            yield f"occupancy_64 and sdf_values disagree {name}"


def _voxel_of(points_canonical: Float[np.ndarray, "point 3"]) -> tuple[np.ndarray, ...]:
    """Index of each point into the grid with a border of one."""
    return tuple(np.clip(np.floor((points_canonical + 0.5) / VOXEL), 0, 63).astype(np.int64).T + 1)


def _reached_from_the_border(grid: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Free voxels that a path of face neighbours joins to the border of the grid."""
    free = ~grid
    reached = np.zeros_like(grid)
    reached[0] = True  # the border of one is free everywhere
    before = 0
    while (now := int(np.count_nonzero(reached))) != before:
        before = now
        for axis in range(3):
            forward, back = np.moveaxis(reached, axis, 0), np.moveaxis(free, axis, 0)
            for i in range(1, len(forward)):
                forward[i] |= forward[i - 1] & back[i]
            for i in range(len(forward) - 2, -1, -1):
                forward[i] |= forward[i + 1] & back[i]
    return reached


def _dilated(grid: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Occupied, or one of the 26 neighbours is."""
    grown = grid.copy()
    for axis in range(3):
        grown = grown | np.roll(grown, 1, axis) | np.roll(grown, -1, axis)
    return grown


def _mask_problems(masks: Masks) -> Iterator[str]:
    visible = [masks.hand_visible, masks.object_visible, masks.arm_visible]
    for name in ("hand", "object", "arm"):
        if np.any(getattr(masks, f"{name}_visible") & ~getattr(masks, f"{name}_amodal")):
            yield f"visible {name} outside its amodal mask"
    if np.any(np.sum(visible, axis=0) > 1):
        yield "visible masks overlap"


def _geometry_problems(geometry: Geometry, masks: Masks) -> Iterator[str]:
    depth, depth_object = geometry.depth, geometry.depth_object
    if not (np.all(np.isfinite(depth)) and np.all(np.isfinite(depth_object))):
        yield "depth is not finite"
    if min(depth.min(), depth_object.min()) < 0:
        yield "negative depth"
    seen = masks.hand_visible | masks.object_visible | masks.arm_visible
    if np.any(depth[seen] <= 0):
        yield "no depth where something is visible"
    if np.any((depth_object > 0) != masks.object_amodal):
        yield "object.Z and the amodal object mask disagree"
    z, z_object = depth[masks.object_visible], depth_object[masks.object_visible]
    if np.any(np.abs(z - z_object) > DEPTH_TOLERANCE * z_object):
        yield "Z and object.Z differ where the object is visible"
    if np.any(depth[masks.object_amodal] > depth_object[masks.object_amodal] * (1 + DEPTH_TOLERANCE)):
        yield "Z lies behind object.Z"
    if np.any((depth == 0) & masks.object_amodal):
        yield "object.Z where the scene has no depth"
    if not _all_unit(geometry.normals_cam[seen]):
        yield "normals are not unit vectors where something is visible"


def _count_problems(row: FrameRow, masks: Masks) -> Iterator[str]:
    for name in ("hand", "object"):
        counts = {}
        for kind in ("visible", "amodal"):
            mask = getattr(masks, f"{name}_{kind}")
            counts[kind] = int(np.count_nonzero(mask))
            if counts[kind] != getattr(row, f"{name}_pixels_{kind}"):
                yield f"{name}_pixels_{kind} is not the mask's"
            if mask_box_px(mask) != tuple(getattr(row, f"{name}_box_{kind}_px").tolist()):
                yield f"{name}_box_{kind}_px is not the mask's"
        fraction = counts["visible"] / max(1, counts["amodal"])
        if abs(fraction - getattr(row, f"{name}_visible_fraction")) > FRACTION_TOLERANCE:
            yield f"{name}_visible_fraction is not the masks'"


def _pose_problems(row: FrameRow, clip: ClipRow) -> Iterator[str]:
    for name in ("T_cam_from_world", "T_world_from_obj"):
        T = getattr(row, name)
        R = T[:3, :3]
        if (
            np.abs(R @ R.T - np.eye(3)).max() > RIGID_TOLERANCE
            or np.linalg.det(R) < 0
            or not np.array_equal(T[3], [0, 0, 0, 1])
        ):
            yield f"{name} is not rigid"
    expected_px = project_points(transform_points(row.T_cam_from_world, row.joints_world), clip.K)
    behind, recorded_behind = np.isnan(expected_px), np.isnan(row.joints_px)
    if np.any(behind != recorded_behind) or np.any(
        np.abs(expected_px - row.joints_px)[~behind & ~recorded_behind] > REPROJECTION_PX
    ):
        yield "joints_px are not the projection of joints_world"


def _all_unit(vectors: Float[np.ndarray, "*batch 3"]) -> bool:
    return bool(np.all(np.abs(np.linalg.norm(vectors, axis=-1) - 1.0) < NORMAL_TOLERANCE))
