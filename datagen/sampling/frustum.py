"""What the cameras of a finished Scene hold in view: the proof, from the drawn vertices themselves."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from datagen.sampling.cameras import CamerasConfig
from datagen.sampling.framing import image_drift_px, image_margin_px
from datagen.sampling.scene_sampling import SampledMotion
from datagen.scene.scene import Scene
from shards.geometry import transform_points

__all__ = ["CameraReport", "FrustumError", "frustum_report", "require_frustum"]

_TOLERANCE_PX = 1e-3  # of sums in another order


class FrustumError(RuntimeError):
    """A camera does not hold what it was framed for: an error of this package, never of its input."""


@dataclass(frozen=True, kw_only=True)
class CameraReport:
    """One camera over all frames, pixels."""

    min_margin_px: float  # a hand or object vertex to the image border, worst; -inf behind the camera
    object_drift_px: float


def frustum_report(scene: Scene) -> tuple[CameraReport, ...]:
    """Margin of every hand-model and object vertex in every frame, and drift of the object, per camera."""
    hand = scene.hand_verts_world[:, : scene.hand_surface.n_hand_verts]
    margins_px = [np.inf] * len(scene.cameras)
    for frame, T_world_from_obj in enumerate(scene.T_world_from_obj):  # one at a time: meshes may be large
        obj = transform_points(T_world_from_obj, scene.object_mesh.verts_obj)
        points = np.concatenate([hand[frame], obj])[None]
        for number, camera in enumerate(scene.cameras):
            T_cam_from_world = camera.T_cam_from_world[frame : frame + 1]
            margin_px = image_margin_px(points, camera.K, T_cam_from_world, camera.image_size)
            margins_px[number] = min(margins_px[number], margin_px)
    center = _object_center_world(scene)
    return tuple(
        CameraReport(
            min_margin_px=margin_px,
            object_drift_px=image_drift_px(center, camera.K, camera.T_cam_from_world),
        )
        for camera, margin_px in zip(scene.cameras, margins_px)
    )


def require_frustum(sampled: SampledMotion, config: CamerasConfig) -> None:
    """FrustumError unless every camera keeps `margin` and `max_drift`, and its recorded metrics are true."""
    side = min(config.image_size)
    for number, (report, metrics) in enumerate(zip(frustum_report(sampled.scene), sampled.camera_metrics)):
        checks = (
            ("vertices keep", report.min_margin_px, ">=", config.margin * side),
            ("the object drifts", report.object_drift_px, "<=", config.max_drift * side),
            ("the recorded margin is", metrics.min_margin_px, "==", report.min_margin_px),
            ("the recorded drift is", metrics.object_drift_px, "==", report.object_drift_px),
        )
        for what, found, relation, expected in checks:
            excess = {">=": expected - found, "<=": found - expected, "==": abs(found - expected)}[relation]
            if not excess <= _TOLERANCE_PX:
                raise FrustumError(
                    f"{sampled.scene.motion_id}, camera {number}: {what} {found:.3f} px, expected "
                    f"{relation} {expected:.3f} px; please report this with the configuration and the seed"
                )


def _object_center_world(scene: Scene) -> Float[np.ndarray, "frame 3"]:
    """Centre of the object's bounding box, carried along with the object. Metres."""
    verts = scene.object_mesh.verts_obj
    center = 0.5 * (verts.min(axis=0) + verts.max(axis=0))
    return scene.T_world_from_obj[:, :3, :3] @ center + scene.T_world_from_obj[:, :3, 3]
