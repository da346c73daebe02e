"""What the cameras of a finished Scene hold in view: the proof, from the drawn vertices themselves."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.geometry.raycast import TriangleCaster
from datagen.sampling.framing import image_drift_px, image_margin_px
from datagen.sampling.visibility import VisibilityProbe
from datagen.scene.scene import Scene
from shards.geometry import transform_points

__all__ = ["CameraReport", "frustum_report", "object_center_world"]

PROBE_RAYS = 96


@dataclass(frozen=True, kw_only=True)
class CameraReport:
    """One camera over all frames. Visible fractions are of a coarse grid of rays."""

    kind: str
    min_margin_px: float  # a hand or object vertex to the image border, worst; -inf behind the camera
    object_drift_px: float
    visible_fraction_min: float
    visible_fraction_mean: float
    object_size_px: float  # worst frame


def frustum_report(scene: Scene) -> tuple[CameraReport, ...]:
    """Margins of every hand-model and object vertex in every frame, drift and visibility, per camera."""
    hand = scene.hand_verts_world[:, : scene.hand_surface.n_hand_verts]
    obj = transform_points(
        scene.T_world_from_obj,
        np.broadcast_to(scene.object_mesh.verts_obj, (len(hand), *scene.object_mesh.verts_obj.shape)),
    )
    points = np.concatenate([hand, obj], axis=1)
    probe = VisibilityProbe(
        object_caster=TriangleCaster(scene.object_mesh.verts_obj, scene.object_mesh.faces),
        object_hull_obj=scene.object_mesh.verts_obj,
        T_world_from_obj=scene.T_world_from_obj,
        hand_verts_world=scene.hand_verts_world,
        hand_faces=scene.hand_surface.faces,
        arm_end=np.arange(0),
        rays_across=PROBE_RAYS,
    )
    center = object_center_world(scene)
    reports = []
    for camera in scene.cameras:
        seen = probe.look(camera.K, camera.image_size, camera.T_cam_from_world)
        reports.append(
            CameraReport(
                kind=camera.kind,
                min_margin_px=image_margin_px(points, camera.K, camera.T_cam_from_world, camera.image_size),
                object_drift_px=image_drift_px(center, camera.K, camera.T_cam_from_world),
                visible_fraction_min=float(seen.visible_fraction.min()),
                visible_fraction_mean=float(seen.visible_fraction.mean()),
                object_size_px=float(seen.object_size_px.min()),
            )
        )
    return tuple(reports)


def object_center_world(scene: Scene) -> Float[np.ndarray, "frame 3"]:
    """Centre of the object's bounding box, carried along with the object. Metres."""
    verts = scene.object_mesh.verts_obj
    center = 0.5 * (verts.min(axis=0) + verts.max(axis=0))
    return scene.T_world_from_obj[:, :3, :3] @ center + scene.T_world_from_obj[:, :3, 3]
