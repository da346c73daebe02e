"""sRGB: the published curve, there and back, in either precision."""

import numpy as np
import pytest

from shards.color import linear_from_srgb, srgb_from_linear

ALL_8_BIT = np.arange(256) / 255.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_every_8_bit_value_comes_back_in_its_own_dtype(dtype: type) -> None:
    srgb: np.ndarray = ALL_8_BIT.astype(dtype)
    linear = linear_from_srgb(srgb)
    assert linear.dtype == srgb_from_linear(linear).dtype == dtype
    assert (np.diff(linear) > 0).all()
    np.testing.assert_array_equal(np.round(255.0 * srgb_from_linear(linear)), np.arange(256))


def test_known_points_of_iec_61966_2_1() -> None:
    np.testing.assert_allclose(
        linear_from_srgb(np.array([0.0, 0.04045, 0.5, 1.0])), [0.0, 0.0031308, 0.21404114, 1.0], rtol=1e-4
    )


def test_values_beyond_the_range() -> None:
    np.testing.assert_allclose(srgb_from_linear(np.array([-0.5, 2.0])), [0.0, 1.0], atol=1e-12)
    below, above = linear_from_srgb(np.array([-0.5, 2.0]))
    assert below == 0.0
    assert above == pytest.approx((2.055 / 1.055) ** 2.4)  # emission is not cut off
