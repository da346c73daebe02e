"""How much of the object a camera sees, by a coarse grid of rays: cheap enough for every candidate."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from datagen.raycast import TriangleCaster, pixel_rays, projected_window
from shards.geometry import invert_transform

__all__ = ["SeenFigures", "VisibilityProbe"]


@dataclass(frozen=True, kw_only=True)
class SeenFigures:
    """Per probed frame."""

    visible_fraction: Float[np.ndarray, "probed"]  # 0..1; 0 when no ray meets the object
    object_size_px: Float[np.ndarray, "probed"]  # square root of its amodal area, full-size pixels


class VisibilityProbe:
    """The object, and hand with arm at a few frames of a motion, shared by all candidates of all cameras."""

    def __init__(
        self,
        *,
        object_caster: TriangleCaster,
        object_hull_obj: Float[np.ndarray, "hull 3"],
        T_world_from_obj: Float[np.ndarray, "frame 4 4"],
        hand_verts_world: Float[np.ndarray, "frame vert 3"],
        hand_faces: Int[np.ndarray, "face 3"],
        frames: Int[np.ndarray, "probed"],
        rays_across: int,
    ) -> None:
        self.frames = frames
        self._object = object_caster
        self._hull = object_hull_obj
        self._T_world_from_obj = T_world_from_obj
        self._hands = [TriangleCaster(hand_verts_world[f].astype(np.float64), hand_faces) for f in frames]
        self._rays_across = rays_across

    def look(
        self,
        K: Float[np.ndarray, "3 3"],
        image_size: tuple[int, int],
        T_cam_from_world: Float[np.ndarray, "frame 4 4"],
    ) -> SeenFigures:
        """Rays through an image of `rays_across` pixels; the size in pixels is scaled back."""
        coarse = self._rays_across / image_size[0]
        size = (self._rays_across, max(1, round(image_size[1] * coarse)))
        K_coarse = K * np.array([[coarse], [coarse], [1.0]])
        fractions, sizes = np.zeros(len(self.frames)), np.zeros(len(self.frames))
        for i, (frame, hand) in enumerate(zip(self.frames, self._hands)):
            T_cam_from_obj = T_cam_from_world[frame] @ self._T_world_from_obj[frame]
            window = projected_window(self._hull, T_cam_from_obj, K_coarse, size)
            row, column = np.divmod(np.arange(np.prod(window.shape)), max(window.shape[1], 1))
            rays = pixel_rays(K_coarse, window, row, column)
            depth = self._object.cast(invert_transform(T_cam_from_obj), rays).depth
            hit = np.isfinite(depth)
            if not hit.any():
                continue
            before = hand.cast(invert_transform(T_cam_from_world[frame]), rays[hit]).depth < depth[hit]
            fractions[i] = 1.0 - np.mean(before)
            sizes[i] = np.sqrt(np.count_nonzero(hit)) / coarse
        return SeenFigures(visible_fraction=fractions, object_size_px=sizes)
