"""Means of what several ranks have measured: samples count each, objects once."""

import math

import numpy as np
import pytest

from model.training.task import Measurements, merged


def share(numbers: list[float], of_objects: dict[str, float], shade: int = 0) -> Measurements:
    return Measurements(
        numbers={"found": numbers},
        of_objects={"true": of_objects},
        images={"image": np.full((1, 1, 3), shade, np.uint8)},
    )


def test_samples_count_each_and_objects_once():
    shares = [share([1.0, 2.0], {"ball": 4.0, "cup": 1.0}), share([6.0], {"ball": 4.0, "plate": 10.0})]
    assert merged(shares).evaluation().metrics == {"found": 3.0, "true": 5.0}


def test_the_order_of_shares_changes_no_bit():
    numbers = np.random.default_rng(0).normal(size=(3, 50)).tolist()
    shares = [share(values, {str(i): values[0]}) for i, values in enumerate(numbers)]
    assert merged(shares).evaluation().metrics == merged(shares[::-1]).evaluation().metrics


def test_a_rank_without_batches_adds_nothing_and_nothing_at_all_is_nan():
    assert merged([share([2.0], {"cup": 1.0}), share([], {})]).evaluation().metrics == {
        "found": 2.0,
        "true": 1.0,
    }
    nothing = merged([share([], {}), share([], {})]).evaluation().metrics
    assert list(nothing) == ["found", "true"]
    assert all(math.isnan(value) for value in nothing.values())


def test_images_are_those_of_the_first_share():
    images = merged([share([], {}, shade=7), share([], {}, shade=9)]).images
    assert images["image"].item(0) == pytest.approx(7)
