"""Exact geometry buffers of a Scene by ray casting: depth, visible and amodal masks, normals, boxes.

Every surface is cast on its own through the same pixel centres, so amodal masks come for free and
visible ones are a comparison of depths. The object's hierarchy is built once per motion and the
hand's once per frame; all cameras share them. Surfaces are the drawn triangles, without pixel
filter, depth of field or motion blur; glass counts as solid.
"""

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from datagen.geometry.raycast import PixelWindow, TriangleCaster, cast_window, pixel_rays, projected_window
from datagen.scene.scene import HAND_SKIN, CameraPath, HandSurface, Scene, Table
from datagen.scene.table_mesh import inside_flat_top, table_from_world, table_mesh
from shards.geometry import invert_transform, transform_points
from shards.storage.images import MASK_BITS, mask_box_px

__all__ = [
    "ARM_AMODAL",
    "ARM_VISIBLE",
    "HAND_AMODAL",
    "HAND_VISIBLE",
    "OBJECT_AMODAL",
    "OBJECT_VISIBLE",
    "FrameGeometry",
    "MotionGeometry",
    "PartMetrics",
    "annotate_frame",
    "hand_object_distances",
]

# Bits of FrameGeometry.masks are those of the shard format. Arm: forearm and sleeve.
HAND_VISIBLE, HAND_AMODAL = MASK_BITS["hand_visible"], MASK_BITS["hand_amodal"]
OBJECT_VISIBLE, OBJECT_AMODAL = MASK_BITS["object_visible"], MASK_BITS["object_amodal"]
ARM_VISIBLE, ARM_AMODAL = MASK_BITS["arm_visible"], MASK_BITS["arm_amodal"]


@dataclass(frozen=True, kw_only=True)
class PartMetrics:
    """One part in one image. Boxes are x0 y0 x1 y1 in pixel edges, -1 four times when empty."""

    box_visible_px: Int[np.ndarray, "4"]
    box_amodal_px: Int[np.ndarray, "4"]
    pixels_visible: int
    pixels_amodal: int

    @property
    def visible_fraction(self) -> float:
        """Visible / amodal pixels inside the image, 0..1; 0 when there are none."""
        return self.pixels_visible / self.pixels_amodal if self.pixels_amodal else 0.0


@dataclass(frozen=True, kw_only=True)
class FrameGeometry:
    """One frame of one camera, at pixel centres. Depth is z in the camera frame, metres, 0 = nothing."""

    depth: Float32[np.ndarray, "height width"]  # hand, arm, object and table
    depth_object: Float32[np.ndarray, "height width"]  # the object alone, as if nothing were before it
    normals_cam: Float32[np.ndarray, "height width 3"]  # unit, of the visible triangle, toward the camera
    masks: UInt8[np.ndarray, "height width"]  # bits HAND_VISIBLE ... ARM_AMODAL
    hand: PartMetrics  # without the arm
    object: PartMetrics
    arm: PartMetrics


@dataclass(frozen=True, kw_only=True)
class _Layer:
    """One surface in one frame, ready to be cast for any camera. Bits are 0 for the table."""

    caster: TriangleCaster
    T_world_from_layer: Float[np.ndarray, "4 4"]
    visible_bit: int
    amodal_bit: int


class MotionGeometry:
    """What stays the same over a motion: the scene, the object's and the table's hierarchies."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.object = TriangleCaster(scene.object_mesh.verts_obj.astype(np.float64), scene.object_mesh.faces)
        self.table: TriangleCaster | None = None
        if scene.table is not None:
            slab = table_mesh(scene.table)
            self.table = TriangleCaster(slab.verts_world, slab.faces)
        self._parts = hand_and_arm(scene.hand_surface)

    def layers(self, frame: int) -> tuple[_Layer, ...]:
        """Object, hand and arm as they stand in one frame (an arm without triangles is left out)."""
        verts = self.scene.hand_verts_world[frame].astype(np.float64)
        layers = [
            _Layer(
                caster=self.object,
                T_world_from_layer=self.scene.T_world_from_obj[frame],
                visible_bit=OBJECT_VISIBLE,
                amodal_bit=OBJECT_AMODAL,
            )
        ]
        bits = ((HAND_VISIBLE, HAND_AMODAL), (ARM_VISIBLE, ARM_AMODAL))
        for (used, faces), (visible_bit, amodal_bit) in zip(self._parts, bits):
            if len(faces):
                layers.append(
                    _Layer(
                        caster=TriangleCaster(verts[used], faces),
                        T_world_from_layer=np.eye(4),
                        visible_bit=visible_bit,
                        amodal_bit=amodal_bit,
                    )
                )
        return tuple(layers)


def annotate_frame(geometry: MotionGeometry, frame: int) -> tuple[FrameGeometry, ...]:
    """Buffers of one frame for every camera of the scene, in their order."""
    layers = geometry.layers(frame)
    return tuple(_annotate(geometry, layers, camera, frame) for camera in geometry.scene.cameras)


def hand_object_distances(scene: Scene) -> Float[np.ndarray, " frame"]:
    """Smallest signed distance of the hand's own vertices to the drawn object mesh, metres, per frame.

    Negative inside; the sign is the winding number of the nearest candidates, so a mesh of open
    sheets has an outside only.
    """
    hand = scene.hand_verts_world[:, : scene.hand_surface.n_hand_verts].astype(np.float64)
    points = transform_points(invert_transform(scene.T_world_from_obj), hand)
    verts = np.ascontiguousarray(scene.object_mesh.verts_obj, np.float64)
    faces = np.ascontiguousarray(scene.object_mesh.faces, np.int64)
    squared = igl.point_mesh_squared_distance(points.reshape(-1, 3), verts, faces)[0]
    distance = np.sqrt(squared).reshape(points.shape[:2])
    low, high = verts.min(axis=0), verts.max(axis=0)
    candidates = np.all((points >= low) & (points <= high), axis=-1)
    if candidates.any():
        winding = igl.fast_winding_number(verts, faces, np.ascontiguousarray(points[candidates]))
        distance[candidates] *= np.where(winding > 0.5, -1.0, 1.0)
    return distance.min(axis=1)


def hand_and_arm(
    surface: HandSurface,
) -> tuple[tuple[Int[np.ndarray, " used"], Int[np.ndarray, "face 3"]], ...]:
    """(vertices used, faces into them) of the hand's skin, then of forearm and sleeve."""
    parts = []
    for chosen in (surface.face_part == HAND_SKIN, surface.face_part != HAND_SKIN):
        used, faces = np.unique(surface.faces[chosen], return_inverse=True)
        parts.append((used, faces.reshape(-1, 3)))
    return tuple(parts)


class _Image:
    """Buffers of one image while surfaces are laid over each other, nearest first."""

    def __init__(self, camera: CameraPath, T_cam_from_world: Float[np.ndarray, "4 4"]) -> None:
        width, height = camera.image_size
        self.camera = camera
        self.T_cam_from_world = T_cam_from_world
        self.depth = np.full((height, width), np.inf)
        self.depth_object = np.zeros((height, width), np.float32)
        self.normals_cam = np.zeros((height, width, 3), np.float32)
        self.amodal = np.zeros((height, width), np.uint8)
        self.visible = np.zeros((height, width), np.uint8)
        self.windows: dict[int, PixelWindow] = {}  # by amodal bit, where metrics have to look

    def lay(self, layer: _Layer) -> None:
        T_cam_from_layer = self.T_cam_from_world @ layer.T_world_from_layer
        camera, caster = self.camera, layer.caster
        window = projected_window(caster.verts, T_cam_from_layer, camera.K, camera.image_size)
        hits = cast_window(caster, T_cam_from_layer, camera.K, window)
        here = window.slices
        hit = hits.triangle >= 0
        self.windows[layer.amodal_bit] = window
        self.amodal[here][hit] |= layer.amodal_bit
        if layer.amodal_bit == OBJECT_AMODAL:
            self.depth_object[here][hit] = hits.depth[hit]
        nearer = hits.depth < self.depth[here]
        self.depth[here][nearer] = hits.depth[nearer]
        self.visible[here][nearer] = layer.visible_bit
        self.normals_cam[here][nearer] = caster.unit_normals_cam(
            invert_transform(T_cam_from_layer),
            hits.triangle[nearer],
            pixel_rays(camera.K, window, *np.nonzero(nearer)),
        )

    def lay_table(self, table: Table, caster: TriangleCaster) -> None:
        """The flat top in closed form, where the camera looks down on it; rays for the rounded border."""
        camera = self.camera
        T_world_from_cam = invert_transform(self.T_cam_from_world)
        window = projected_window(caster.verts, self.T_cam_from_world, camera.K, camera.image_size)
        depth, normals, visible = (
            image[window.slices] for image in (self.depth, self.normals_cam, self.visible)
        )
        top_depth, y, x = _flat_top_depth(table, T_world_from_cam, camera.K, window)
        nearer = top_depth < depth
        depth[nearer] = top_depth[nearer]
        normals[nearer] = self.T_cam_from_world[:3, 2]  # up, seen by the camera
        visible[nearer] = 0

        rays = pixel_rays(camera.K, window, y, x)
        hits = caster.cast(T_world_from_cam, rays)
        near = hits.depth < depth[y, x]
        y, x = y[near], x[near]
        depth[y, x] = hits.depth[near]
        normals[y, x] = caster.unit_normals_cam(T_world_from_cam, hits.triangle[near], rays[near])
        visible[y, x] = 0

    def metrics(self, visible_bit: int, amodal_bit: int) -> PartMetrics:
        window = self.windows.get(amodal_bit, PixelWindow(x0=0, y0=0, x1=0, y1=0))
        visible = (self.visible[window.slices] & visible_bit) > 0
        amodal = (self.amodal[window.slices] & amodal_bit) > 0
        return PartMetrics(
            box_visible_px=_box(visible, window),
            box_amodal_px=_box(amodal, window),
            pixels_visible=int(np.count_nonzero(visible)),
            pixels_amodal=int(np.count_nonzero(amodal)),
        )


def _annotate(
    geometry: MotionGeometry, layers: tuple[_Layer, ...], camera: CameraPath, frame: int
) -> FrameGeometry:
    image = _Image(camera, camera.T_cam_from_world[frame])
    for layer in layers:
        image.lay(layer)
    if geometry.scene.table is not None and geometry.table is not None:
        image.lay_table(geometry.scene.table, geometry.table)
    return FrameGeometry(
        depth=np.where(np.isfinite(image.depth), image.depth, 0.0).astype(np.float32),
        depth_object=image.depth_object,
        normals_cam=image.normals_cam,
        masks=image.visible | image.amodal,
        hand=image.metrics(HAND_VISIBLE, HAND_AMODAL),
        object=image.metrics(OBJECT_VISIBLE, OBJECT_AMODAL),
        arm=image.metrics(ARM_VISIBLE, ARM_AMODAL),
    )


def _flat_top_depth(
    table: Table, T_world_from_cam: Float[np.ndarray, "4 4"], K: Float[np.ndarray, "3 3"], window: PixelWindow
) -> tuple[Float[np.ndarray, "height width"], Int[np.ndarray, " pixel"], Int[np.ndarray, " pixel"]]:
    """Depth of the flat top (inf beside it); row and column of the pixels that may see the slab's border.

    From above, a ray that goes down meets the plane of the top before any other part of the slab.
    """
    R, center = T_world_from_cam[:3, :3], T_world_from_cam[:3, 3]
    above = center[2] - table.top_z_m
    if above <= 0.0:
        y, x = np.indices(window.shape)
        return np.full(window.shape, np.inf), y.reshape(-1), x.reshape(-1)
    to_table = table_from_world(table)
    start_x, start_y = to_table[:, :2] @ center[:2] + to_table[:, 2]
    slope_x, slope_y, rise = (_ray_component(row, K, window) for row in (*(to_table[:, :2] @ R[:2]), R[2]))
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -above / rise
        hit_x, hit_y = start_x + depth * slope_x, start_y + depth * slope_y
    descends = rise < -1e-9
    on_top = inside_flat_top(table, hit_x, hit_y) & descends

    # Between the planes of top and bottom a ray passes over a segment; wholly beside the slab: no hit.
    y, x = np.nonzero(descends & ~on_top)
    through = -table.thickness_m / rise[y, x]
    beside = np.zeros(len(y), dtype=bool)
    for hit, slope, size in zip((hit_x, hit_y), (slope_x, slope_y), table.size_xy_m):
        start, end = hit[y, x], hit[y, x] + through * slope[y, x]
        beside |= (np.minimum(start, end) > 0.5 * size) | (np.maximum(start, end) < -0.5 * size)
    return np.where(on_top, depth, np.inf), y[~beside], x[~beside]


def _ray_component(
    row: Float[np.ndarray, "3"], K: Float[np.ndarray, "3 3"], window: PixelWindow
) -> Float[np.ndarray, "height width"]:
    """row . ray of every pixel of a window: a sum of a row vector and a column vector."""
    x = (np.arange(window.x0, window.x1) + 0.5 - K[0, 2]) / K[0, 0]
    y = (np.arange(window.y0, window.y1) + 0.5 - K[1, 2]) / K[1, 1]
    return row[0] * x + (row[1] * y + row[2])[:, None]


def _box(mask: Bool[np.ndarray, "height width"], window: PixelWindow) -> Int[np.ndarray, "4"]:
    """`mask_box_px` of a window of the image, in pixels of the image."""
    box = np.array(mask_box_px(mask))
    return box if box[0] < 0 else box + np.array([window.x0, window.y0, window.x0, window.y0])
