"""Forearm and sleeve behind a hand: rigid with the wrist joint, they close the wrist in every image."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from datagen.hands.forearm_uv import continued_uv
from datagen.hands.model import PosedHand, ShapedHand
from datagen.hands.tube import close_end, tube_corner_uv, tube_faces

__all__ = [
    "ARM_SKIN",
    "HAND_SKIN",
    "SLEEVE",
    "ArmStyle",
    "DressedHand",
    "dress_hand",
    "dressed_verts",
    "wrist_cap",
]

HAND_SKIN, ARM_SKIN, SLEEVE = 0, 1, 2  # the values of datagen.scene.HandSurface.face_part

_ROW_M = 0.006
# Half-widths of a forearm relative to the wrist ring's, at fractions of its length: nearly straight
# behind the wrist, widest over the muscle bellies, narrower again before the elbow.
_PROFILE_AT = (0.0, 0.12, 0.3, 0.5, 0.7, 0.85, 1.0)
_PROFILE_SIDE = (1.0, 0.98, 1.06, 1.22, 1.36, 1.40, 1.34)  # thumb side to little finger side
_PROFILE_BACK = (1.0, 1.02, 1.16, 1.42, 1.66, 1.74, 1.66)  # back to palm side
_ROUNDING_M = 0.05  # over this length the wrist ring becomes an ellipse
_FLARE_M = 0.045  # over this length the slope of the hand at the ring dies out
_MAX_FLARE = 0.5
_DOME = np.sin(np.linspace(0.0, 0.5 * np.pi, 6)[1:-1])
_SLEEVE_COLUMNS = 56
_SLEEVE_ROW_M = 0.004
_LINING_M = 0.05  # how deep one can look into a sleeve before it is closed around the arm
_CLOTH_M = 0.0016


@dataclass(frozen=True, kw_only=True)
class ArmStyle:
    """Shape of what is seen behind the wrist."""

    length_m: float  # wrist ring to the closed end
    girth: float  # 1: average; changes the elbow side, never the wrist
    sleeve_start_m: float | None  # wrist ring to the edge of the cuff; None: a bare arm
    sleeve_gap_m: float  # between skin and cloth at the cuff
    cuff_m: float  # length of the thicker, stiffer border
    fold_depth_m: float
    fold_phase_rad: float  # moves the folds


@dataclass(frozen=True, kw_only=True, eq=False)
class DressedHand:
    """Hand, forearm and sleeve as one mesh; topology in the terms of `datagen.scene.scene.HandSurface`.

    The hand model's vertices come first. The forearm starts on its wrist ring; the cap that closes
    the bare model is left out.
    """

    shaped: ShapedHand
    faces: Int[np.ndarray, "face 3"]
    corner_uv: Float[np.ndarray, "face 3 2"]
    face_part: Int[np.ndarray, " face"]
    n_hand_verts: int
    extra_verts_wrist: Float[np.ndarray, "extra 3"]  # relative to the rest wrist joint, rest axes


@dataclass(frozen=True, kw_only=True, eq=False)
class _ArmAxis:
    """Cylinder coordinates around the forearm: distance behind the wrist ring, angle, radius."""

    origin: Float[np.ndarray, "3"]  # centre of the wrist ring
    axis: Float[np.ndarray, "3"]  # away from the hand
    side: Float[np.ndarray, "3"]  # towards the thumb
    back: Float[np.ndarray, "3"]
    ring_angle: Float[np.ndarray, " column"]
    ring_radius: Float[np.ndarray, " column"]
    ring_slant: Float[np.ndarray, " column"]  # of the ring along the axis, metres
    ring_flare: Float[np.ndarray, " column"]  # change of the hand's radius per metre towards the arm
    half_widths: Float[np.ndarray, "2"]  # of the wrist: side, back


def dress_hand(shaped: ShapedHand, style: ArmStyle) -> DressedHand:
    """Add forearm and sleeve. ValueError when the sleeve would start beyond the end of the arm."""
    if style.sleeve_start_m is not None and not 0.0 <= style.sleeve_start_m < style.length_m - style.cuff_m:
        raise ValueError(
            f"ArmStyle.sleeve_start_m is {style.sleeve_start_m}; expected 0 .. length_m - cuff_m "
            f"= {style.length_m - style.cuff_m:.3f}, or None for a bare arm"
        )
    model = shaped.model
    hand = ~wrist_cap(model.faces, model.wrist_loop)
    frame = _arm_axis(shaped, model.faces[hand])
    arm_verts, arm_faces, arm_uv = _forearm(shaped, frame, style, model.faces[hand], model.corner_uv[hand])
    n_hand, n_loop = len(shaped.verts_rest), len(model.wrist_loop)
    index = np.concatenate([model.wrist_loop, n_hand + np.arange(len(arm_verts) - n_loop)])
    faces, uv = [model.faces[hand], index[arm_faces]], [model.corner_uv[hand], arm_uv]
    extra, parts = [arm_verts[n_loop:]], [HAND_SKIN, ARM_SKIN]
    if style.sleeve_start_m is not None:
        verts, sleeve_faces, sleeve_uv = _sleeve(frame, style, style.sleeve_start_m)
        faces.append(sleeve_faces + n_hand + len(extra[0]))
        uv.append(sleeve_uv)
        extra.append(verts)
        parts.append(SLEEVE)
    return DressedHand(
        shaped=shaped,
        faces=np.concatenate(faces),
        corner_uv=np.concatenate(uv),
        face_part=np.repeat(parts, [len(part) for part in faces]),
        n_hand_verts=n_hand,
        extra_verts_wrist=np.concatenate(extra) - shaped.joints_rest[0],
    )


def dressed_verts(dressed: DressedHand, posed: PosedHand) -> Float[np.ndarray, "frame vert 3"]:
    """Vertices of the whole surface in the world, metres: the posed hand's own, then the rigid extras."""
    T_world_from_wrist = posed.T_world_from_joint[:, 0]
    extra_world = np.einsum("fab,eb->fea", T_world_from_wrist[:, :3, :3], dressed.extra_verts_wrist)
    extra_world += T_world_from_wrist[:, None, :3, 3]
    return np.concatenate([posed.verts_world, extra_world], axis=1)


def wrist_cap(faces: Int[np.ndarray, "face 3"], loop: Int[np.ndarray, " loop"]) -> Bool[np.ndarray, " face"]:
    """Faces beyond the wrist ring: the smaller of the parts into which the ring cuts the mesh, if it does."""
    ring_edges = np.sort(np.stack([loop, np.roll(loop, -1)], axis=1), axis=1)
    on_ring = {tuple(edge) for edge in ring_edges.tolist()}
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    face = np.tile(np.arange(len(faces)), 3)
    inner = np.array([tuple(edge) not in on_ring for edge in edges.tolist()])
    edges, face = edges[inner], face[inner]
    order = np.lexsort(edges.T)
    edges, face = edges[order], face[order]
    same = (edges[1:] == edges[:-1]).all(axis=1)
    pairs = (np.ones(same.sum()), (face[:-1][same], face[1:][same]))
    n_parts, part = connected_components(coo_array(pairs, shape=(len(faces),) * 2), directed=False)
    return part != np.bincount(part).argmax() if n_parts > 1 else np.zeros(len(faces), dtype=bool)


def _arm_axis(shaped: ShapedHand, hand_faces: Int[np.ndarray, "hand_face 3"]) -> _ArmAxis:
    """The forearm continues the line from the middle knuckle through the wrist joint."""
    wrist, index, middle, little = shaped.joints_rest[[0, 1, 4, 7]]
    axis = (wrist - middle) / np.linalg.norm(wrist - middle)
    side = index - little - axis * ((index - little) @ axis)
    side /= np.linalg.norm(side)
    back = np.cross(axis, side)
    loop = shaped.model.wrist_loop
    origin = shaped.verts_rest[loop].mean(axis=0)
    local = (shaped.verts_rest - origin) @ np.stack([side, back, axis], axis=1)
    across, radius = local[loop, :2], np.linalg.norm(local[:, :2], axis=1)
    profile = np.stack([radius, local[:, 2]], axis=1)
    step = profile[loop] - [_mean_neighbour(vert, loop, hand_faces, profile) for vert in loop.tolist()]
    flare = np.clip(step[:, 0] / np.maximum(step[:, 1], 1e-3), -_MAX_FLARE, _MAX_FLARE)
    return _ArmAxis(
        origin=origin,
        axis=axis,
        side=side,
        back=back,
        ring_angle=np.arctan2(across[:, 1], across[:, 0]),
        ring_radius=radius[loop],
        ring_slant=local[loop, 2],
        ring_flare=0.25 * np.roll(flare, 1) + 0.5 * flare + 0.25 * np.roll(flare, -1),
        half_widths=0.5 * np.ptp(across, axis=0),
    )


def _mean_neighbour(
    vert: int,
    loop: Int[np.ndarray, " loop"],
    faces: Int[np.ndarray, "face 3"],
    values: Float[np.ndarray, "vert 2"],
) -> Float[np.ndarray, "2"]:
    """Mean over the neighbours of a ring vertex that lie inside the hand."""
    around = np.unique(faces[(faces == vert).any(axis=1)])
    return values[np.setdiff1d(around, loop)].mean(axis=0)


def _radius(
    frame: _ArmAxis,
    style: ArmStyle,
    distance_m: Float[np.ndarray, "*grid"],
    angle_rad: Float[np.ndarray, "*grid"],
) -> Float[np.ndarray, "*grid"]:
    """Radius of the bare arm: leaves the wrist ring with the hand's own slope, becomes a swelling ellipse."""
    fraction = np.clip(distance_m / style.length_m, 0.0, 1.0)
    wider = 1.0 + (style.girth - 1.0) * np.clip(fraction / 0.4, 0.0, 1.0)
    half_side = frame.half_widths[0] * np.interp(fraction, _PROFILE_AT, _PROFILE_SIDE) * wider
    half_back = frame.half_widths[1] * np.interp(fraction, _PROFILE_AT, _PROFILE_BACK) * wider
    ellipse = 1.0 / np.hypot(np.cos(angle_rad) / half_side, np.sin(angle_rad) / half_back)
    ring = np.interp(angle_rad, frame.ring_angle, frame.ring_radius, period=2 * np.pi)
    flare = np.interp(angle_rad, frame.ring_angle, frame.ring_flare, period=2 * np.pi)
    flare_m = flare * distance_m * np.clip(1.0 - distance_m / _FLARE_M, 0.0, 1.0) ** 2
    return ring + flare_m + (ellipse - ring) * _smoothstep(distance_m / _ROUNDING_M)


def _points(
    frame: _ArmAxis,
    distance_m: Float[np.ndarray, "*grid"],
    angle_rad: Float[np.ndarray, "*grid"],
    radius_m: Float[np.ndarray, "*grid"],
) -> Float[np.ndarray, "*grid 3"]:
    """Cylinder coordinates to the rest frame. Sections near the wrist are slanted like its ring."""
    slant = np.interp(angle_rad, frame.ring_angle, frame.ring_slant, period=2 * np.pi)
    along = distance_m + slant * (1.0 - _smoothstep(distance_m / (2 * _ROUNDING_M)))
    local = np.stack([radius_m * np.cos(angle_rad), radius_m * np.sin(angle_rad), along], axis=-1)
    return frame.origin + local @ np.stack([frame.side, frame.back, frame.axis])


def _smoothstep(x: Float[np.ndarray, "*grid"]) -> Float[np.ndarray, "*grid"]:
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _forearm(
    shaped: ShapedHand,
    frame: _ArmAxis,
    style: ArmStyle,
    hand_faces: Int[np.ndarray, "hand_face 3"],
    hand_corner_uv: Float[np.ndarray, "hand_face 3 2"],
) -> tuple[Float[np.ndarray, "vert 3"], Int[np.ndarray, "face 3"], Float[np.ndarray, "face 3 2"]]:
    """Bare arm: its first row is the wrist ring, its end a dome."""
    n_columns = len(frame.ring_angle)
    dome_m = 0.6 * frame.half_widths.mean()
    straight = np.linspace(0.0, style.length_m - dome_m, round((style.length_m - dome_m) / _ROW_M) + 1)
    rows = np.concatenate([straight, straight[-1] + dome_m * _DOME])
    shrink = np.concatenate([np.ones(len(straight)), np.sqrt(1.0 - _DOME**2)])
    distance, angle = np.meshgrid(rows, frame.ring_angle, indexing="ij")
    radius = _radius(frame, style, distance, angle) * shrink[:, None]
    verts = _points(frame, distance, angle, radius).reshape(-1, 3)
    ring = shaped.verts_rest[shaped.model.wrist_loop]
    verts[:n_columns] = ring
    verts = np.concatenate([verts, (frame.origin + frame.axis * style.length_m)[None]])
    apex = len(verts) - 1
    faces = np.concatenate(
        [tube_faces(len(rows), n_columns), close_end(np.arange(apex - n_columns, apex), apex, at_start=False)]
    )
    uv = continued_uv(
        arm_faces=faces,
        arm_ring=np.concatenate([np.tile(ring, (len(rows), 1)), ring.mean(axis=0, keepdims=True)]),
        arm_distance_m=np.append(distance.reshape(-1), style.length_m),
        axis=frame.axis,
        hand_triangles=shaped.verts_rest[hand_faces],
        hand_corner_uv=hand_corner_uv,
    )
    return verts, faces, uv


def _sleeve(
    frame: _ArmAxis, style: ArmStyle, start_m: float
) -> tuple[Float[np.ndarray, "vert 3"], Int[np.ndarray, "face 3"], Float[np.ndarray, "face 3 2"]]:
    """Cloth over the end of the arm: lining, rounded rim, outer wall, closed beyond the arm.

    The lining ends in a disc across the arm, so no ray gets between arm and cloth.
    """
    end_m = style.length_m + style.sleeve_gap_m
    length = np.linspace(start_m, end_m, round((end_m - start_m) / _SLEEVE_ROW_M) + 1)
    lining = length[length <= start_m + _LINING_M][::-1]
    rim = np.linspace(0.0, np.pi, 6)[1:-1]
    cuff = 0.5 * (1.0 - np.tanh((length - start_m - style.cuff_m) / 0.002))  # 1 on the border, 0 behind it
    thickness = _CLOTH_M * (1.0 + cuff)
    distance = np.concatenate([lining, start_m - 0.5 * thickness[0] * np.sin(rim), length, [end_m + 0.004]])
    rim_outward = 0.5 * thickness[0] * (1.0 - np.cos(rim))
    outward = np.concatenate([np.zeros(len(lining)), rim_outward, thickness, [_CLOTH_M]])
    shrink = np.append(np.ones(len(distance) - 1), 0.8)
    direction = 1.0 if _runs_with_angle(frame) else -1.0
    turn = direction * np.arange(_SLEEVE_COLUMNS) * (2 * np.pi / _SLEEVE_COLUMNS)
    s, angle = np.meshgrid(distance, turn, indexing="ij")
    radius = _radius(frame, style, np.maximum(s, start_m), angle) + _drape(style, s, angle, start_m)
    radius = (radius + outward[:, None]) * shrink[:, None]
    ends = [frame.origin + frame.axis * along for along in (lining[0], end_m + 0.007)]
    verts = np.concatenate([_points(frame, s, angle, radius).reshape(-1, 3), np.stack(ends)])
    n_rows, n_cells = len(distance), len(distance) * _SLEEVE_COLUMNS
    faces = np.concatenate(
        [
            tube_faces(n_rows, _SLEEVE_COLUMNS),
            close_end(np.arange(_SLEEVE_COLUMNS), n_cells, at_start=True),
            close_end(np.arange(n_cells - _SLEEVE_COLUMNS, n_cells), n_cells + 1, at_start=False),
        ]
    )
    return verts, faces, tube_corner_uv(faces, _SLEEVE_COLUMNS, (distance - start_m) / style.length_m)


def _runs_with_angle(frame: _ArmAxis) -> bool:
    """Whether the wrist loop runs in the sense of growing angle."""
    return bool(np.sin(np.diff(frame.ring_angle)).sum() > 0.0)


def _drape(
    style: ArmStyle,
    distance_m: Float[np.ndarray, "*grid"],
    angle_rad: Float[np.ndarray, "*grid"],
    start_m: float,
) -> Float[np.ndarray, "*grid"]:
    """Distance of the cloth from the arm: a gap that widens, and soft folds that begin behind the cuff."""
    behind = np.maximum(distance_m - start_m, 0.0)
    begin = _smoothstep((behind - 0.7 * style.cuff_m) / 0.02)
    phase = style.fold_phase_rad
    bend = 1.1 * np.sin(angle_rad + phase) + 0.7 * np.sin(2 * angle_rad - 1.7 * phase)
    around = 0.55 + 0.45 * np.sin(angle_rad - phase + 14.0 * behind)
    wide = np.sin(2 * np.pi * behind / 0.041 + bend)
    narrow = np.sin(2 * np.pi * behind / 0.023 - 2 * bend)
    gap = style.sleeve_gap_m * (1.0 + 0.6 * behind / style.length_m)
    return gap + style.fold_depth_m * begin * around * (0.5 + 0.35 * wide + 0.15 * narrow)
