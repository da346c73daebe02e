import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.grasps.object_movement import measure_movement


def _turning(angle_rad: float) -> np.ndarray:
    T = np.tile(np.eye(4), (50, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.linspace(0, angle_rad, 50)[:, None] * [1.0, 0, 0]).as_matrix()
    return T


def test_a_resting_object_shows_less_than_half_of_itself():
    movement = measure_movement(_turning(0.0))
    assert movement.rotation_range_rad == pytest.approx(0.0, abs=1e-6)
    assert movement.view_coverage == pytest.approx((1 - 0.25) / 2, abs=0.02)  # spherical cap


def test_turning_shows_more_and_is_measured_exactly():
    coverage = [measure_movement(_turning(a)).view_coverage for a in (0.0, 0.8, 1.6, 3.0)]
    assert coverage == sorted(coverage)
    assert measure_movement(_turning(1.3)).rotation_range_rad == pytest.approx(1.3, abs=1e-6)


def test_an_empty_motion_is_an_error():
    with pytest.raises(ValueError, match="empty"):
        measure_movement(np.zeros((0, 4, 4)))
