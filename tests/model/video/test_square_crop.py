"""Crops show what they say they show, and masks find the way back."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.data.crop import Augmentation, crop_image, draw_crop
from model.errors import ModelError
from model.video.frames import VideoFrame
from model.video.square_crop import (
    SquareWindow,
    box_from_masks,
    mask_on_source,
    parsed_box,
    square_crop,
    square_window,
)

boxes = st.tuples(st.floats(-40, 150), st.floats(-40, 100), st.floats(20, 200), st.floats(20, 200)).map(
    lambda b: np.array([b[0], b[1], b[0] + b[2], b[1] + b[3]])
)

points_px = st.tuples(st.floats(-500, 500), st.floats(-500, 500))


def frame_of(image: np.ndarray, source_size: tuple[int, int] | None = None) -> VideoFrame:
    size = (image.shape[1], image.shape[0])
    return VideoFrame(image=image, index=0, time_s=0.0, name="f", source_size=source_size or size, changes=())


def disc(size: tuple[int, int], center: tuple[float, float], radius: float) -> np.ndarray:
    """Pixels (width, height) whose centre is within `radius`."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    return (x - center[0]) ** 2 + (y - center[1]) ** 2 <= radius**2


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))


@given(box=boxes, size=st.integers(8, 600), points=st.lists(points_px, min_size=1))
def test_both_directions_are_inverse(box: np.ndarray, size: int, points: list[tuple[float, float]]) -> None:
    window = square_window((200, 120), box, size)
    px = np.array(points)
    np.testing.assert_allclose(window.image_from_crop(window.crop.points(px)), px, atol=1e-6)
    corners = window.crop.points(box.reshape(2, 2))
    assert corners.min() >= -1e-6
    assert corners.max() <= size + 1e-6
    assert np.isclose((corners[1] - corners[0]).max(), size)  # as small as possible
    np.testing.assert_allclose(corners.mean(axis=0), size / 2, atol=1e-6)


@pytest.mark.parametrize("size", [(160, 96), (96, 160), (50, 50)])
def test_without_a_box_the_largest_centred_square(size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    side = min(size)
    crop, window = square_crop(image, None, side)
    x, y = (size[0] - side) // 2, (size[1] - side) // 2
    assert (window.corner_px, window.side_px) == ((x, y), side)
    np.testing.assert_array_equal(
        crop, image[y : y + side, x : x + side].transpose(2, 0, 1) / np.float32(255)
    )
    assert crop.dtype == np.float32


def test_pixels_are_those_of_training() -> None:
    """The same box through the crop of the training data."""
    image = np.random.default_rng(0).integers(0, 256, (120, 200, 3), dtype=np.uint8)
    box = np.array([30.0, 20.0, 110.0, 90.0])
    plain = Augmentation(margin=(1.0, 1.0), shift=0.0, roll_deg=(0.0, 0.0), flip_probability=0.0)
    for size in (40, 64, 128):
        trained = draw_crop(box, np.diag([100.0, 100.0, 1.0]), size, plain, np.random.default_rng(0))
        expected = crop_image(image, trained).transpose(2, 0, 1) / np.float32(255)
        np.testing.assert_array_equal(square_crop(image, box, size)[0], expected)


def test_outside_of_the_image_is_black() -> None:
    crop, window = square_crop(np.full((40, 40, 3), 255, np.uint8), np.array([-20.0, 10.0, 20.0, 50.0]), 40)
    assert window.corner_px == (-20, 10)
    assert crop[:, :, :19].max() == 0
    assert crop[:, 31:, :].max() == 0
    assert crop[:, :29, 21:].min() == 1


@settings(max_examples=60, deadline=None)
@given(
    center=st.tuples(st.floats(50, 110), st.floats(40, 60)),
    radius=st.floats(12, 30),
    margin=st.floats(1.0, 1.6),
    size=st.sampled_from([64, 128, 224]),
    first=st.one_of(st.none(), st.just(np.array([-10.0, -30.0, 170.0, 150.0]))),
)
def test_box_of_a_second_pass_holds_what_the_first_one_saw(
    center: tuple[float, float],
    radius: float,
    margin: float,
    size: int,
    first: np.ndarray | None,
) -> None:
    """A disc is drawn, cropped, found on the crop: the new box is its box times the margin."""
    window = square_window((160, 96), first, size)
    u, v = window.crop.points(np.array(center))
    scale = size / window.side_px
    mask = disc((size, size), (float(u), float(v)), radius * scale)
    box = box_from_masks([mask, np.zeros_like(mask)], window, margin)
    assert box is not None
    low, high = (
        np.maximum(np.array(center) - radius, window.image_from_crop(np.zeros(2))),
        np.minimum(np.array(center) + radius, window.image_from_crop(np.full(2, float(size)))),
    )
    pixel = 1 / scale
    middle, half = (low + high) / 2, margin * (high - low) / 2
    np.testing.assert_allclose(box, [*(middle - half), *(middle + half)], atol=margin * pixel + 1e-6)
    again = square_window((160, 96), box, size)
    for point in ((center[0] - radius, center[1]), (center[0] + radius, center[1])):
        if window.crop.points(np.array(point)).min() > 0 and window.crop.points(np.array(point)).max() < size:
            seen = again.crop.points(np.array(point))
            assert -1.5 * size / again.side_px * pixel <= seen.min()
            assert seen.max() <= size + 1.5 * size / again.side_px * pixel


def test_stray_pixels_do_not_widen_the_box_but_a_hand_does() -> None:
    window = square_window((100, 100), None, 100)
    thing = disc((100, 100), (50, 50), 15)
    speck = disc((100, 100), (95, 5), 2)
    hand = disc((100, 100), (85, 50), 8)
    alone = box_from_masks([thing], window, 1.0)
    np.testing.assert_array_equal(box_from_masks([thing | speck], window, 1.0), alone)
    with_hand = box_from_masks([thing, hand], window, 1.0)
    assert with_hand is not None
    assert with_hand[2] == 93
    assert box_from_masks([np.zeros((100, 100), bool)] * 2, window, 1.2) is None


@settings(max_examples=60, deadline=None)
@given(
    center=st.tuples(st.floats(60, 260), st.floats(40, 150)),
    radius=st.floats(25, 60),
    source_scale=st.sampled_from([1.0, 2.0, 3.75]),
    size=st.sampled_from([96, 224]),
)
def test_masks_come_back_onto_the_source(
    center: tuple[float, float], radius: float, source_scale: float, size: int
) -> None:
    """Drawn in the source, seen in the crop of its scaled-down image, pasted back: the same disc."""
    image_size = (320, 180)
    source_size = (round(320 * source_scale), round(180 * source_scale))
    frame = frame_of(np.zeros((180, 320, 3), np.uint8), source_size)
    box = np.array([center[0] - 80, center[1] - 80, center[0] + 80, center[1] + 80])
    window = square_window(image_size, box, size)
    u, v = window.crop.points(np.array(center))
    on_crop = disc((size, size), (float(u), float(v)), radius * size / window.side_px)
    found = mask_on_source(on_crop.astype(np.float32), window, frame)
    truth = disc(source_size, (center[0] * source_scale, center[1] * source_scale), radius * source_scale)
    assert found.shape == truth.shape
    assert iou(found, truth) > 0.93


def test_the_whole_crop_comes_back_as_its_square_and_nothing_else() -> None:
    frame = frame_of(np.zeros((60, 100, 3), np.uint8), (200, 120))
    for box in ((10.0, 5.0, 40.0, 35.0), (-20.0, -10.0, 30.0, 40.0), (90.0, 50.0, 130.0, 90.0)):
        found = mask_on_source(
            np.ones((37, 37), np.float32), square_window((100, 60), np.array(box), 37), frame
        )
        expected = np.zeros((120, 200), bool)
        x0, y0, x1, y1 = (max(0, round(2 * side)) for side in box)
        expected[y0:y1, x0:x1] = True
        np.testing.assert_array_equal(found, expected)


def test_crop_then_paste_of_equal_pixels_is_exact() -> None:
    mask = np.random.default_rng(0).random((50, 50)) > 0.5
    window = SquareWindow(corner_px=(7.0, 3.0), side_px=50.0, size=50)
    found = mask_on_source(mask.astype(np.float32), window, frame_of(np.zeros((60, 90, 3), np.uint8)))
    np.testing.assert_array_equal(found[3:53, 7:57], mask)
    assert found.sum() == mask.sum()


def test_boxes_from_the_command_line_are_in_source_pixels() -> None:
    frame = frame_of(np.zeros((90, 160, 3), np.uint8), (1920, 1080))
    np.testing.assert_allclose(parsed_box("120, 0,1200,1080", frame), [10, 0, 100, 90])
    for text, part in (
        ("1,2,3", "four numbers"),
        ("a,b,c,d", "four numbers"),
        ("1,2,nan,4", "four numbers"),
        ("5,5,5,9", "no area"),
        ("9,0,1,5", "no area"),
        ("2000,0,2100,10", "outside"),
    ):
        with pytest.raises(ModelError, match=part) as error:
            parsed_box(text, frame)
        assert "1920 x 1080" in str(error.value)


def test_cropped_image_lies_where_the_window_says() -> None:
    """A bright dot of the image is found in the crop where the transform puts it."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        image = np.zeros((96, 160, 3), np.uint8)
        spot = rng.uniform((50, 40), (110, 56))
        image[disc((160, 96), (float(spot[0]), float(spot[1])), 6)] = 255
        box = np.concatenate([rng.uniform(-10, 30, 2), rng.uniform((125, 70), (170, 110))])
        crop, window = square_crop(image, box, 200)
        moments = cv2.moments(crop[0])
        found = np.array([moments["m10"], moments["m01"]]) / moments["m00"] + 0.5
        np.testing.assert_allclose(found, window.crop.points(spot), atol=0.8)
