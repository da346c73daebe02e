import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.grasps.object_movement import measure_movement


def _turning(angle_rad: float) -> np.ndarray:
    T = np.tile(np.eye(4), (50, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.linspace(0, angle_rad, 50)[:, None] * [1.0, 0, 0]).as_matrix()
    return T


def test_a_resting_object_does_not_move():
    movement = measure_movement(_turning(0.0))
    assert movement.rotation_range_rad == pytest.approx(0.0, abs=1e-6)
    assert movement.travel_m == 0.0


@pytest.mark.parametrize("angle_rad", [0.35, 1.3, 3.0])
def test_the_largest_turn_between_any_two_instants(angle_rad):
    there_and_back = np.concatenate([_turning(angle_rad), _turning(angle_rad)[::-1]])
    for T in (_turning(angle_rad), there_and_back):
        assert measure_movement(T).rotation_range_rad == pytest.approx(angle_rad, abs=0.05 * angle_rad)


def test_travel_is_the_length_of_the_path():
    T = _turning(0.0)
    T[:25, 0, 3] = np.linspace(0.0, 0.2, 25)
    T[25:, 0, 3] = np.linspace(0.2, 0.1, 25)
    assert measure_movement(T).travel_m == pytest.approx(0.3)


def test_an_empty_motion_is_an_error():
    with pytest.raises(ValueError, match="empty"):
        measure_movement(np.zeros((0, 4, 4)))
