"""Every hand and object vertex is inside every frame, the object drifts boundedly, cameras turn smoothly."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.geometry.raycast import TriangleCaster
from datagen.sampling.cameras import CamerasConfig, PathStyles, Surroundings, sample_cameras
from datagen.sampling.errors import SamplingError
from datagen.sampling.framing import Framing, Subject, frame_subject, image_drift_px
from datagen.sampling.trajectories import MotionLimits, PathStyle, band_limited, sample_view_path
from datagen.sampling.visibility import VisibilityProbe
from shards.geometry import camera_center, in_frustum, transform_points

LIMITS = MotionLimits(angular_speed_deg_s=70.0, angular_acceleration_deg_s2=260.0, shake_band_hz=(0.3, 1.5))
STYLE = PathStyle(
    weight=1.0,
    fov_deg=(28.0, 75.0),
    elevation_deg=(8.0, 65.0),
    azimuth_sweep_deg=(0.0, 20.0),
    elevation_sweep_deg=(0.0, 10.0),
    zoom_out=(1.0, 1.1),
    floor_distance_m=(0.2, 0.6),
    roll_deg=6.0,
    shake_deg=1.0,
    shake_m=0.004,
)
STYLES: dict[str, dict[str, Any]] = {
    "orbit": {"azimuth_sweep_deg": (60.0, 360.0)},
    "arc": {"azimuth_sweep_deg": (20.0, 80.0), "elevation_sweep_deg": (10.0, 50.0)},
    "handheld": {"shake_deg": 4.0, "shake_m": 0.015},
    "dolly": {"zoom_out": (1.3, 2.0)},
    "egocentric": {"elevation_deg": (30.0, 70.0), "floor_distance_m": (0.35, 0.6), "shake_deg": 2.0},
}


def style_of(kind: str) -> PathStyle:
    return PathStyle(
        **{**{name: getattr(STYLE, name) for name in STYLE.__dataclass_fields__}, **STYLES[kind]}
    )


def random_subject(rng: np.random.Generator) -> Subject:
    """A hand-sized and an object-sized cloud on a smooth random path, turning as they go."""
    n_frames, fps = int(rng.integers(2, 31)), float(rng.choice([8.0, 10.0, 25.0, 30.0]))
    hand = rng.normal(size=(60, 3)) * rng.uniform(0.02, 0.06)
    obj = rng.uniform(-0.5, 0.5, size=(40, 3)) * rng.uniform(0.02, 0.3, size=3) + rng.normal(size=3) * 0.05
    path = np.cumsum(band_limited(n_frames, fps, (0.1, 1.0), rng, 3), axis=1).T * rng.uniform(0.0, 1.0) / fps
    turn = band_limited(n_frames, fps, (0.1, 1.0), rng, 3).T * rng.uniform(0.0, 2.0)
    R = Rotation.from_rotvec(turn).as_matrix()
    origin = rng.normal(size=3) + path
    points = np.einsum("tij,pj->tpi", R, np.concatenate([hand, obj])) + origin[:, None]
    center = np.einsum("tij,j->ti", R, obj.mean(axis=0)) + origin
    return Subject(points_world=points, object_center_world=center, fps=fps)


def random_framing(rng: np.random.Generator) -> Framing:
    size = (int(rng.integers(64, 1025)), int(rng.integers(64, 1025)))
    side = min(size)
    return Framing(
        image_size=size,
        margin_px=rng.uniform(0.0, 0.2) * side,
        near_m=rng.uniform(0.02, 0.3),
        max_drift_px=rng.uniform(0.0, 0.2) * side,
        smoothing_s=rng.uniform(0.05, 0.6),
    )


def draw(kind: str, seed: int):
    rng = np.random.default_rng([seed, list(STYLES).index(kind)])
    subject, framing, style = random_subject(rng), random_framing(rng), style_of(kind)
    path = sample_view_path(
        style,
        LIMITS,
        rng,
        n_frames=len(subject.object_center_world),
        fps=subject.fps,
        azimuth_rad=rng.uniform(0.0, 2.0 * np.pi),
        elevation_deg=style.elevation_deg,
        slack=(1.0, 1.3),
    )
    return subject, framing, frame_subject(subject, path, framing)


@pytest.mark.parametrize("kind", STYLES)
def test_thousand_random_motions_stay_in_every_frame(kind):
    for seed in range(200):  # x 5 kinds
        subject, framing, (K, T) = draw(kind, seed)
        points_cam = transform_points(T, subject.points_world)
        assert np.all(in_frustum(points_cam, K, framing.image_size, framing.margin_px - 1e-6)), (kind, seed)
        assert points_cam[..., 2].min() >= framing.near_m, (kind, seed)
        drift = image_drift_px(subject.object_center_world, K, T)
        assert drift <= framing.max_drift_px + 1e-6, (kind, seed)
        assert_turns_smoothly(T, subject.fps, (kind, seed))


def assert_turns_smoothly(T_cam_from_world, fps, which):
    R = T_cam_from_world[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    assert np.all(np.abs(R[:, 2, 2]) < np.sin(np.radians(80.1))), which  # "up" is defined
    # Angular velocity in the world between neighbouring frames.
    velocity = Rotation.from_matrix(np.swapaxes(R[1:], 1, 2) @ R[:-1]).as_rotvec() * fps
    assert np.degrees(np.linalg.norm(velocity, axis=-1).max()) <= LIMITS.angular_speed_deg_s * 1.001, which
    if len(velocity) > 1:
        acceleration = np.linalg.norm(np.diff(velocity, axis=0), axis=-1).max() * fps
        assert np.degrees(acceleration) <= LIMITS.angular_acceleration_deg_s2 * 1.001, which


def test_a_still_subject_is_framed_as_tightly_as_the_margin_allows():
    rng = np.random.default_rng(0)
    style = PathStyle(
        **{**{n: getattr(STYLE, n) for n in STYLE.__dataclass_fields__}, "floor_distance_m": (0.01, 0.01)}
    )
    for _ in range(20):
        points = rng.normal(size=(1, 50, 3)) * 0.05 + np.array([0.3, 0.2, 0.1])
        subject = Subject(points_world=points, object_center_world=points.mean(axis=1), fps=10.0)
        still = PathStyle(**{**style.__dict__, "shake_deg": 0.0, "shake_m": 0.0})
        path = sample_view_path(
            still,
            LIMITS,
            rng,
            n_frames=1,
            fps=10.0,
            azimuth_rad=1.0,
            elevation_deg=(20.0, 40.0),
            slack=(1.0, 1.0),
        )
        path = type(path)(**{**path.__dict__, "slack": np.ones(1)})
        framing = Framing(
            image_size=(200, 120), margin_px=10.0, near_m=0.01, max_drift_px=50.0, smoothing_s=0.1
        )
        K, T = frame_subject(subject, path, framing)
        points_cam = transform_points(T, points)
        assert in_frustum(points_cam, K, (200, 120), 10.0 - 1e-6).all()
        assert not in_frustum(points_cam, K, (200, 120), 10.0 + 1e-3).all()


def cameras_config(**changes) -> CamerasConfig:
    values = {
        "n_cameras": 6,
        "image_size": (256, 256),
        "margin": 0.04,
        "near_m": 0.12,
        "slack": (1.0, 1.3),
        "max_drift": 0.08,
        "smoothing_s": 0.25,
        "limits": LIMITS,
        "styles": PathStyles(**{kind: style_of(kind) for kind in STYLES}),
        "free_elevation_deg": (-30.0, 60.0),
        "table_clearance_m": 0.05,
        "arm_clearance_m": 0.1,
        "min_visible": 0.3,
        "min_visible_mean": 0.4,
        "min_object_size": 0.05,
        "attempts": 30,
        "arm_end_attempts": 4,
        "probe_rays": 48,
    }
    return CamerasConfig(**{**values, **changes})


def ball_behind_a_plate(n_frames: int = 8):
    """An object ball beside a hand that is a plate: from its far side the ball is hidden."""
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.04)
    plate = trimesh.creation.box((0.005, 0.18, 0.18))
    ball_verts, plate_verts = np.array(ball.vertices), np.array(plate.vertices) + np.array([0.06, 0.0, 0.0])
    T = np.tile(np.eye(4), (n_frames, 1, 1))
    T[:, 2, 3] = 0.3 + 0.02 * np.arange(n_frames)
    hand = plate_verts + T[:, None, :3, 3]
    subject = Subject(
        points_world=np.concatenate([hand, ball_verts + T[:, None, :3, 3]], axis=1),
        object_center_world=T[:, :3, 3].copy(),
        fps=10.0,
    )
    probe = VisibilityProbe(
        object_caster=TriangleCaster(ball_verts, np.array(ball.faces)),
        object_hull_obj=ball_verts,
        T_world_from_obj=T,
        hand_verts_world=hand,
        hand_faces=np.array(plate.faces),
        arm_end=np.arange(0),
        rays_across=48,
    )
    around = Surroundings(
        arm_verts_world=hand + np.array([0.3, 0.0, 0.0]),
        forearm_direction_world=np.array([1.0, 0.0, 0.0]),
        table_top_z_m=0.2,
    )
    return subject, probe, around


def rngs(seed: int, n: int = 6) -> list[np.random.Generator]:
    return [np.random.default_rng([seed, index]) for index in range(n)]


def test_cameras_see_the_object_stay_clear_and_repeat():
    config, (subject, probe, around) = cameras_config(), ball_behind_a_plate()
    cameras, metrics = sample_cameras(config, subject, probe, around, rngs(3))
    again, _ = sample_cameras(config, subject, probe, around, rngs(3))
    assert len(cameras) == 6
    for camera, same, metric in zip(cameras, again, metrics):
        np.testing.assert_array_equal(camera.T_cam_from_world, same.T_cam_from_world)
        assert metric.visible_fraction_min >= config.min_visible
        assert metric.min_margin_px >= config.margin * 256 - 1e-6
        assert camera_center(camera.T_cam_from_world)[:, 2].min() >= 0.2 + config.table_clearance_m
    assert max(metric.attempts for metric in metrics) > 1  # the plate hid the ball from some candidates


def test_a_hidden_object_is_an_error_with_metrics():
    subject, probe, around = ball_behind_a_plate()
    config = cameras_config(min_visible=0.999, min_visible_mean=0.999, min_object_size=0.9, attempts=3)
    with pytest.raises(SamplingError, match=r"none of 3 candidates.*object size / image 0\.\d+ < 0\.900"):
        sample_cameras(config, subject, probe, around, rngs(0, 1))


def test_the_probe_counts_what_is_hidden():
    _, probe, _ = ball_behind_a_plate()
    K = np.array([[256.0, 0.0, 128.0], [0.0, 256.0, 128.0], [0.0, 0.0, 1.0]])
    for side, visible in ((-1.0, 1.0), (1.0, 0.0)):
        T = np.tile(np.eye(4), (8, 1, 1))
        T[:, :3, :3] = [[0.0, side, 0.0], [0.0, 0.0, -1.0], [-side, 0.0, 0.0]]  # looks along -side x
        T[:, :3, 3] = np.array([[0.0, 0.3 + 0.02 * t, 0.4] for t in range(8)])
        seen = probe.look(K, (256, 256), T)
        np.testing.assert_allclose(seen.visible_fraction, visible)
        radius = 256.0 * 0.04 / np.sqrt(0.4**2 - 0.04**2)
        np.testing.assert_allclose(seen.object_size_px, np.sqrt(np.pi) * radius, rtol=0.1)
