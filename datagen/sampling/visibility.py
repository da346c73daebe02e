"""How much of the object a camera sees, by a coarse grid of rays: cheap enough for every candidate."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from datagen.geometry.raycast import TriangleCaster, pixel_rays, projected_window
from shards.geometry import in_frustum, invert_transform, transform_points

__all__ = ["SeenMetrics", "VisibilityProbe"]

SAME_SURFACE_M = 0.002


@dataclass(frozen=True, kw_only=True)
class SeenMetrics:
    """Per frame."""

    visible_fraction: Float[np.ndarray, " frame"]  # 0..1; 0 when no ray meets the object
    arm_end_seen: Bool[np.ndarray, " frame"]  # the end of the drawn arm is in the image
    object_size_px: Float[np.ndarray, " frame"]  # square root of its amodal area, full-size pixels


class VisibilityProbe:
    """The object, and hand with arm in every frame of a clip, shared by all candidates of all cameras."""

    def __init__(
        self,
        *,
        object_caster: TriangleCaster,
        object_hull_obj: Float[np.ndarray, "hull 3"],
        T_world_from_obj: Float[np.ndarray, "frame 4 4"],
        hand_verts_world: Float[np.ndarray, "frame vert 3"],
        hand_faces: Int[np.ndarray, "face 3"],
        arm_end: Int[np.ndarray, " end"],  # vertices of the arm's end among the hand's
        rays_across: int,
    ) -> None:
        self._object = object_caster
        self._hull = object_hull_obj
        self._T_world_from_obj = T_world_from_obj
        self._hands = [TriangleCaster(verts.astype(np.float64), hand_faces) for verts in hand_verts_world]
        self._arm_end_world = hand_verts_world[:, arm_end].astype(np.float64)
        self._rays_across = rays_across

    def look(
        self,
        K: Float[np.ndarray, "3 3"],
        image_size: tuple[int, int],
        T_cam_from_world: Float[np.ndarray, "frame 4 4"],
    ) -> SeenMetrics:
        """Rays through an image of `rays_across` pixels; the size in pixels is scaled back."""
        coarse = self._rays_across / image_size[0]
        size = (self._rays_across, max(1, round(image_size[1] * coarse)))
        K_coarse = K * np.array([[coarse], [coarse], [1.0]])
        fractions, sizes = np.zeros(len(self._hands)), np.zeros(len(self._hands))
        for frame, hand in enumerate(self._hands):
            T_cam_from_obj = T_cam_from_world[frame] @ self._T_world_from_obj[frame]
            window = projected_window(self._hull, T_cam_from_obj, K_coarse, size)
            row, column = np.divmod(np.arange(np.prod(window.shape)), max(window.shape[1], 1))
            rays = pixel_rays(K_coarse, window, row, column)
            depth = self._object.cast(invert_transform(T_cam_from_obj), rays).depth
            hit = np.isfinite(depth)
            if not hit.any():
                continue
            before = hand.cast(invert_transform(T_cam_from_world[frame]), rays[hit]).depth < depth[hit]
            fractions[frame] = 1.0 - np.mean(before)
            sizes[frame] = np.sqrt(np.count_nonzero(hit)) / coarse
        return SeenMetrics(
            visible_fraction=fractions,
            object_size_px=sizes,
            arm_end_seen=self._arm_end_seen(K, image_size, T_cam_from_world),
        )

    def _arm_end_seen(
        self,
        K: Float[np.ndarray, "3 3"],
        image_size: tuple[int, int],
        T_cam_from_world: Float[np.ndarray, "frame 4 4"],
    ) -> Bool[np.ndarray, " frame"]:
        seen = np.zeros(len(self._hands), dtype=bool)
        ends_cam = transform_points(T_cam_from_world, self._arm_end_world)
        inside = in_frustum(ends_cam, K, image_size)
        for frame in np.flatnonzero(inside.any(axis=1)):
            ends = ends_cam[frame, inside[frame]]
            rays = ends / ends[:, 2:]
            depth = self._hands[frame].cast(invert_transform(T_cam_from_world[frame]), rays).depth
            seen[frame] = np.any(depth > ends[:, 2] - SAME_SURFACE_M)
        return seen
