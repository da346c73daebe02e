"""Crop, roll and mirror: the geometry after it renders the image after it."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.data.batch import TrainingSample
from model.data.crop import (
    Augmentation,
    SquareCrop,
    crop_image,
    crop_masks,
    draw_crop,
    mirrored,
    union_box,
)
from model.errors import ModelError
from shards.geometry import project_points, transform_points
from shards.storage.images import MASK_BITS, mask_box_px
from tests.model.data.voxel_scene import (
    RENDER_ERROR_PX,
    lopsided_occupancy,
    outline_distance_px,
    render_mask,
)

OCCUPANCY = lopsided_occupancy()
SOURCE = (160, 120)  # width, height
OBLONG = np.sqrt(200 / 170)  # the longer side of a source pixel over that of the square of its area, at most
PLAIN = Augmentation(margin=(1.0, 1.0), shift=0.0, roll_deg=(0.0, 0.0), flip_probability=0.0)


def random_pose(rng: np.random.Generator) -> np.ndarray:
    """The unit cube, 20 cm wide, turned anyhow, half a metre in front of the camera."""
    Q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3] = 0.2 * Q * np.sign(np.linalg.det(Q))
    T[:3, 3] = [rng.uniform(-0.05, 0.05), rng.uniform(-0.05, 0.05), rng.uniform(0.5, 0.7)]
    return T


def random_intrinsics(rng: np.random.Generator) -> np.ndarray:
    """Neither square pixels nor a principal point in the middle."""
    return np.array(
        [
            [rng.uniform(170, 200), 0.0, rng.uniform(65, 95)],
            [0.0, rng.uniform(170, 200), rng.uniform(45, 75)],
            [0.0, 0.0, 1.0],
        ]
    )


@dataclass(frozen=True, kw_only=True)
class Cropped:
    """A sample of one view of the lopsided object, and how its image was cropped."""

    sample: TrainingSample
    crop: SquareCrop


def cropped_sample(seed: int, size: int, augmentation: Augmentation) -> Cropped:
    rng = np.random.default_rng(seed)
    T, K = random_pose(rng), random_intrinsics(rng)
    mask = render_mask(OCCUPANCY, T, K, SOURCE)
    bits = (mask * np.uint8(MASK_BITS["object_amodal"])).astype(np.uint8)
    rgb = rng.integers(0, 256, (SOURCE[1], SOURCE[0], 3), dtype=np.uint8)
    joints_cam = transform_points(T, rng.uniform(-0.5, 0.5, (21, 3)))
    crop = draw_crop(union_box(np.array([mask_box_px(mask)]), SOURCE), K, size, augmentation, rng)
    masks = crop_masks(bits, crop)
    sample = TrainingSample(
        motion_id="m",
        object_uid="o",
        clip_ids=("c",),
        frame_indices=np.array([0]),
        images=(crop_image(rgb, crop).transpose(2, 0, 1)[None] / np.float32(255)).astype(np.float32),
        object_amodal=masks.object_amodal[None],
        object_visible=masks.object_visible[None],
        hand_visible=masks.hand_visible[None],
        K=crop.K[None].astype(np.float32),
        T_cam_from_canonical=(crop.T_crop_from_cam @ T)[None].astype(np.float32),
        occupancy=OCCUPANCY,
        joints_px=crop.points(project_points(joints_cam, K))[None].astype(np.float32),
        is_right=True,
    )
    crop_joints = project_points(joints_cam @ crop.T_crop_from_cam[:3, :3].T, crop.K)
    np.testing.assert_allclose(sample.joints_px[0], crop_joints, atol=1e-3)
    return Cropped(sample=sample, crop=crop)


def scale_of(crop: SquareCrop) -> float:
    """Pixels of the crop per pixel of the source image."""
    return float(np.sqrt(np.linalg.det(crop.A_crop_from_image[:, :2])))


def reach_px(crop: SquareCrop) -> float:
    """How far from a pixel of the crop, in its pixels, the source pixels lie that can decide its mask.

    Bilinear interpolation looks at the pixels whose centres are within one step along both axes: a source
    pixel, or, where the crop shrinks, an average of those within half a step and half a source pixel. Such
    steps divide the source window evenly, so they are up to an eighth longer than a pixel of the crop.
    """
    scale = scale_of(crop)
    steps = scale if scale >= 1.0 else 1.5 * max(scale, 1.125) + 0.5 * scale
    return OBLONG * np.sqrt(2) * steps


def seen_in_source(crop: SquareCrop) -> np.ndarray:
    """Pixels of the crop that nothing beyond the border of the source image can decide."""
    centers = np.stack(np.meshgrid(*[np.arange(crop.size) + 0.5] * 2), axis=-1)
    source = (centers - crop.A_crop_from_image[:, 2]) @ np.linalg.inv(crop.A_crop_from_image[:, :2]).T
    margin = OBLONG * reach_px(crop) / scale_of(crop)
    return np.all((source > margin) & (source < np.array(SOURCE) - margin), axis=-1)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.sampled_from([48, 96, 160, 224]),
    roll=st.floats(-180, 180),
    flip=st.booleans(),
)
def test_geometry_after_the_crop_renders_the_mask_after_the_crop(seed, size, roll, flip):
    """Every pixel that the resolution of the source image leaves no doubt about."""
    varied = Augmentation(margin=(1.05, 1.5), shift=1.0, roll_deg=(roll, roll), flip_probability=0.0)
    cropped = cropped_sample(seed, size, varied)
    sample, known = cropped.sample, seen_in_source(cropped.crop)
    if flip:
        sample, known = mirrored(sample), known[:, ::-1]
    T, K, mask = sample.T_cam_from_canonical[0], sample.K[0], sample.object_amodal[0]
    inside_px = outline_distance_px(
        sample.occupancy, T.astype(np.float64), K.astype(np.float64), (size, size)
    )
    doubt_px = reach_px(cropped.crop) + RENDER_ERROR_PX * (1 + scale_of(cropped.crop))
    assert mask[known & (inside_px > doubt_px)].all()
    assert not mask[known & (inside_px < -doubt_px)].any()


@pytest.mark.parametrize("size", [32, 224])
def test_the_mask_is_not_shifted(size):
    """Rounding to source pixels has no preferred direction: on average the centres of area agree.

    Counting pixels from their corners instead of their centres would shift by half the difference in size.
    """
    wide = Augmentation(margin=(1.5, 1.5), shift=0.0, roll_deg=(-180.0, 180.0), flip_probability=0.0)
    shifts, scales = [], []
    for seed in range(60):
        cropped = cropped_sample(seed, size, wide)
        mask, known = cropped.sample.object_amodal[0], seen_in_source(cropped.crop)
        T, K = (m[0].astype(np.float64) for m in (cropped.sample.T_cam_from_canonical, cropped.sample.K))
        again = render_mask(OCCUPANCY, T, K, (size, size))
        if not np.any(again & ~known):
            shifts.append(np.argwhere(mask).mean(axis=0) - np.argwhere(again).mean(axis=0))
            scales.append(scale_of(cropped.crop))
    standard_error = np.std(shifts, axis=0) / np.sqrt(len(shifts))
    half_a_pixel = 0.5 * abs(np.mean(scales) - 1.0)
    assert len(shifts) >= 20
    assert np.all(4.0 * standard_error < half_a_pixel), "too few to tell"
    assert np.all(np.abs(np.mean(shifts, axis=0)) < 4.0 * standard_error)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_mirroring_twice_is_the_identity(seed):
    augmentation = replace(PLAIN, margin=(1.2, 1.2), roll_deg=(-30.0, 30.0))
    sample = cropped_sample(seed, 64, augmentation).sample
    once, twice = mirrored(sample), mirrored(mirrored(sample))
    assert not once.is_right
    assert not np.array_equal(once.occupancy, sample.occupancy)
    for name in ("images", "object_amodal", "object_visible", "hand_visible", "occupancy", "is_right"):
        np.testing.assert_array_equal(getattr(twice, name), getattr(sample, name))
    np.testing.assert_allclose(twice.K, sample.K, rtol=1e-6)
    np.testing.assert_array_equal(twice.T_cam_from_canonical, sample.T_cam_from_canonical)
    np.testing.assert_allclose(twice.joints_px, sample.joints_px, atol=1e-4)


def test_mirrored_pose_is_still_right_handed():
    sample = cropped_sample(1, 64, PLAIN).sample
    assert np.linalg.det(mirrored(sample).T_cam_from_canonical[0, :3, :3]) > 0


K_CENTERED = np.array([[100.0, 0.0, 32.0], [0.0, 100.0, 32.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("corner", [(0, 0), (8, 16), (32, 32)])
def test_crop_at_scale_one_is_a_slice(corner):
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)
    bits = rng.choice(np.array([0, 9, 10, 5, 26], np.uint8), (64, 64))
    x, y = corner
    crop = draw_crop(np.array([x, y, x + 32.0, y + 32.0]), K_CENTERED, 32, PLAIN, rng)
    window = (slice(y, y + 32), slice(x, x + 32))
    np.testing.assert_array_equal(crop_image(rgb, crop), rgb[window])
    masks = crop_masks(bits, crop)
    np.testing.assert_array_equal(masks.object_amodal, bits[window] & 8 != 0)
    np.testing.assert_array_equal(masks.object_visible, bits[window] & 2 != 0)
    np.testing.assert_array_equal(masks.hand_visible, bits[window] & 17 != 0)
    np.testing.assert_allclose(crop.K[:2, 2], [32 - x, 32 - y])


@pytest.mark.parametrize(("degrees", "quarter_turns"), [(90.0, -1), (-90.0, 1), (180.0, 2)])
def test_a_quarter_turn_moves_every_pixel_exactly(degrees, quarter_turns):
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)
    crop = draw_crop(
        np.array([8.0, 8.0, 40.0, 40.0]), K_CENTERED, 32, replace(PLAIN, roll_deg=(degrees, degrees)), rng
    )
    np.testing.assert_array_equal(crop_image(rgb, crop), np.rot90(rgb[8:40, 8:40], quarter_turns))


def test_shrinking_averages_instead_of_skipping():
    checkerboard = (np.indices((128, 128)).sum(axis=0) % 2 * 255).astype(np.uint8)
    rgb = np.stack([checkerboard] * 3, axis=-1)
    crop = draw_crop(np.array([0.0, 0.0, 128.0, 128.0]), K_CENTERED, 32, PLAIN, np.random.default_rng(0))
    small = crop_image(rgb, crop)[2:-2, 2:-2].astype(int)
    assert np.abs(small - 127.5).max() <= 1


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), size=st.integers(8, 100))
def test_masks_keep_their_logic(seed, size):
    """Visible within amodal, hand apart from object, whatever the scale and the turn."""
    rng = np.random.default_rng(seed)
    bits = rng.choice(np.array([0, 5, 10, 8, 12, 13, 16, 24], np.uint8), (60, 50))
    varied = Augmentation(margin=(1.0, 2.0), shift=1.0, roll_deg=(-180.0, 180.0), flip_probability=0.0)
    box = np.array([5.0, 5.0, 45.0, 50.0])
    masks = crop_masks(bits, draw_crop(box, K_CENTERED, size, varied, rng))
    assert not np.any(masks.object_visible & ~masks.object_amodal)
    assert not np.any(masks.object_visible & masks.hand_visible)


@settings(max_examples=50)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_whole_box_is_inside(seed):
    rng = np.random.default_rng(seed)
    x0, y0, width, height = rng.uniform(1, 60, 4)
    x1, y1 = x0 + width, y0 + height
    varied = Augmentation(margin=(1.0, 1.3), shift=1.0, roll_deg=(-180.0, 180.0), flip_probability=0.0)
    crop = draw_crop(np.array([x0, y0, x1, y1]), random_intrinsics(rng), 100, varied, rng)
    corners = crop.points(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))
    assert corners.min() > -1e-6
    assert corners.max() < 100 + 1e-6


def test_union_box_ignores_empty_boxes():
    boxes = np.array([[-1, -1, -1, -1], [3, 4, 5, 6]])
    assert union_box(boxes, (10, 20)).tolist() == [3, 4, 5, 6]
    assert union_box(boxes[:1], (10, 20)).tolist() == [0, 0, 10, 20]
    assert union_box(np.array([[0, 5, 4, 9], [3, 4, 5, 6]]), (10, 20)).tolist() == [0, 4, 5, 9]


@pytest.mark.parametrize(
    "change", [{"margin": (0.9, 1.0)}, {"shift": 2.0}, {"roll_deg": (10.0, -10.0)}, {"flip_probability": 1.5}]
)
def test_bad_augmentation_is_one_line(change):
    with pytest.raises(ModelError, match=next(iter(change))) as caught:
        replace(PLAIN, **change)
    assert "\n" not in str(caught.value)
