"""The second, closer square: it holds what was found, and is taken only where it is worth it."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from model.encoders.hand import HandNet, HandNetConfig
from model.inference.crops import CloserCrop, FrameCrop, closer_crop, cropped, first_crops, hand_regions
from model.inference.reconstruction import frames_of_images
from model.video.square_crop import square_window

SIZE = 64
LIMITS = CloserCrop(max_side_share=0.9, min_side_share=0.1)
FRAME = frames_of_images([np.zeros((240, 320, 3), np.uint8)]).frames[0]
WIDE = FrameCrop(box_px=None, origin="centre")


def block(x: int, y: int, width: int, height: int) -> np.ndarray:
    mask = np.zeros((SIZE, SIZE), bool)
    mask[y : y + height, x : x + width] = True
    return mask


@given(
    x=st.integers(0, 55),
    y=st.integers(0, 55),
    width=st.integers(4, 64),
    height=st.integers(4, 64),
    margin=st.floats(1.0, 1.5),
)
def test_the_closer_square_holds_all_that_was_found(x, y, width, height, margin):
    hand, thing = block(x, y, width, height), block(x, y, 8, 8)  # apart, one could count as stray
    crop = closer_crop(FRAME, WIDE, (thing, hand), margin, LIMITS)
    first = square_window(FRAME.image_size, None, SIZE)
    second = square_window(FRAME.image_size, crop.box_px, SIZE)
    if crop is WIDE:
        return
    assert LIMITS.min_side_share <= second.side_px / first.side_px <= LIMITS.max_side_share
    rows, columns = np.nonzero(hand | thing)
    corners = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]], np.float64)
    inside = second.crop.points(first.image_from_crop(corners))
    assert inside.min() >= -1e-9
    assert inside.max() <= SIZE + 1e-9
    # The found box is in the middle, `margin` times smaller than the square.
    np.testing.assert_allclose(inside.mean(axis=0), SIZE / 2)
    np.testing.assert_allclose(np.ptp(inside, axis=0).max() * margin, SIZE)


def test_nothing_found_too_little_and_too_much_change_nothing():
    nothing = block(0, 0, 0, 0)
    for found in (nothing, block(30, 30, 2, 2), block(0, 0, 60, 60)):
        assert closer_crop(FRAME, WIDE, (found, nothing), 1.2, LIMITS) is WIDE
    assert closer_crop(FRAME, WIDE, (block(30, 30, 10, 10), nothing), 1.2, LIMITS).origin == "predicted masks"


def test_first_squares_are_centred_or_given():
    frames = frames_of_images([np.zeros((240, 320, 3), np.uint8)] * 2)
    images, windows = cropped(frames, first_crops(frames, None), SIZE)
    assert images.shape == (2, 3, SIZE, SIZE)
    assert [(w.corner_px, w.side_px) for w in windows] == [((40.0, 0.0), 240.0)] * 2
    box = np.array([10.0, 20.0, 60.0, 50.0])
    _, windows = cropped(frames, first_crops(frames, [box, box + 5]), SIZE)
    assert [(w.corner_px, w.side_px) for w in windows] == [((10.0, 10.0), 50.0), ((15.0, 15.0), 50.0)]


def test_hand_regions_hold_the_joints_of_hands_that_are_seen():
    torch.manual_seed(0)
    network = HandNet(HandNetConfig(image_size=64, stem=(8, 8), decoder=8)).eval()
    images = torch.rand(2, 3, SIZE, SIZE)
    with torch.no_grad():
        network.maps.bias[0] = 50.0
    for region in hand_regions(network, images):
        assert region.any()
        filled_rows = np.flatnonzero(region.any(axis=1))
        assert (np.diff(filled_rows) == 1).all()  # convex
    with torch.no_grad():
        network.maps.bias[0] = -50.0
    assert not any(region.any() for region in hand_regions(network, images))
