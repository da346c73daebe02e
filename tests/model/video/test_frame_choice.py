"""Frames are chosen sharp, different and spread, the same way every time."""

import json

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.errors import ModelError
from model.video.frame_choice import choose_frames, relative_sharpness
from model.video.frames import VideoFrame, VideoFrames

SIZE = 96
RNG = np.random.default_rng(0)
BACKGROUND = cv2.resize(RNG.integers(60, 160, (12, 12, 3), dtype=np.uint8), (SIZE, SIZE))
TEXTURE = RNG.integers(0, 256, (24, 24, 3), dtype=np.uint8)


def scene(x: float, y: float = 30.0, *, turn: int = 0, background: np.ndarray = BACKGROUND) -> np.ndarray:
    """A textured square at (x, y) on a background that stands still."""
    image = background.copy()
    image[round(y) : round(y) + 24, round(x) : round(x) + 24] = np.rot90(TEXTURE, turn)
    return image


def as_frames(images: list[np.ndarray]) -> VideoFrames:
    frames = tuple(
        VideoFrame(
            image=image,
            index=3 * i,
            time_s=0.1 * i,
            name=str(i),
            source_size=(image.shape[1], image.shape[0]),
            changes=(),
        )
        for i, image in enumerate(images)
    )
    return VideoFrames(source="test", kind="video", frames=frames, n_source_frames=3 * len(images), notes=())


@settings(max_examples=40, deadline=None)
@given(
    repeats=st.lists(st.integers(1, 6), min_size=2, max_size=7),
    count=st.integers(1, 8),
    noise=st.booleans(),
)
def test_a_repeated_frame_waits_until_all_others_are_chosen(
    repeats: list[int], count: int, noise: bool
) -> None:
    """Also when a codec has left a little noise on the copies."""
    rng = np.random.default_rng(7)
    shown = [place for place, times in enumerate(repeats) for _ in range(times)]
    images = [scene(10 * place, 8 * place) for place in shown]
    if noise:
        images = [
            np.clip(image + rng.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8) for image in images
        ]
    choice = choose_frames(as_frames(images), count)
    chosen = [shown[position] for position in choice.positions]
    assert len(chosen) == min(count, len(images))
    assert len(set(chosen)) == min(count, len(repeats))


@pytest.mark.parametrize("sigma", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("whole_image", [True, False])
def test_a_blurred_copy_loses_to_its_original(sigma: float, whole_image: bool) -> None:
    """Motion blur of the object alone counts as much as a shaken camera."""

    def blurred(place: int) -> np.ndarray:
        image = scene(10 * place)
        soft = cv2.GaussianBlur(image, (0, 0), sigma)
        if not whole_image:
            x = 10 * place
            image[30:54, x : x + 24] = soft[30:54, x : x + 24]
            return image
        return soft

    for first_is_blurred in (True, False):
        images = []
        for place in range(6):
            pair = [blurred(place), scene(10 * place)]
            images += pair if first_is_blurred else pair[::-1]
        choice = choose_frames(as_frames(images), 6)
        is_sharp = (choice.positions % 2) == (1 if first_is_blurred else 0)
        assert is_sharp.all()
        assert sorted(choice.positions // 2) == list(range(6))


def test_what_moves_decides_not_what_stands_still() -> None:
    """Eleven frames at rest, then the object turns and moves: at most one of the still ones is chosen."""
    busy = np.random.default_rng(3).integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8)
    images = [scene(10, background=busy)] * 11
    images += [scene(20 + 12 * i, 20 + 8 * i, turn=i, background=busy) for i in range(4)]
    choice = choose_frames(as_frames(images), 5)
    assert (choice.positions < 11).sum() == 1


def test_steady_motion_is_sampled_over_its_whole_length() -> None:
    images = [scene(2 * i) for i in range(36)]
    for count in (2, 3, 4, 6):
        positions = choose_frames(as_frames(images), count).positions
        assert len(positions) == count
        assert np.diff(positions).min() >= 36 // (2 * count)
        assert positions[0] < 36 / 2 < positions[-1]


def test_exposure_is_not_content() -> None:
    images = [np.clip(scene(20).astype(int) + 4 * i, 0, 255).astype(np.uint8) for i in range(5)]
    images.insert(2, scene(60))
    assert 2 in choose_frames(as_frames(images), 2).positions


def test_black_frames_come_last() -> None:
    black = np.zeros((SIZE, SIZE, 3), np.uint8)
    images = [black, *[scene(12 * i) for i in range(5)], black]
    choice = choose_frames(as_frames(images), 4)
    assert not {0, 6} & set(choice.positions.tolist())


def test_alike_frames_are_spread_in_time() -> None:
    positions = choose_frames(as_frames([scene(20)] * 9), 3).positions
    assert np.diff(positions).min() >= 3


def test_the_same_frames_give_the_same_choice() -> None:
    images = [scene(2 * i) for i in range(30)]
    first, second = (choose_frames(as_frames([image.copy() for image in images]), 5) for _ in range(2))
    assert first.record() == second.record()
    json.dumps(first.record())


def test_record_says_what_decided() -> None:
    choice = choose_frames(as_frames([scene(10 * i) for i in range(6)]), 3)
    assert (choice.indices == 3 * choice.positions).all()
    assert (np.diff(choice.positions) > 0).all()
    assert sorted(choice.rank) == [0, 1, 2]
    assert choice.novelty[choice.rank == 0] == 1.0
    assert ((choice.sharpness >= 0) & (choice.sharpness <= 1)).all()


def test_images_of_mixed_sizes_can_be_compared() -> None:
    images = [scene(10), cv2.resize(scene(60), (140, 96)), scene(35)]
    assert len(choose_frames(as_frames(images), 2).positions) == 2


def test_one_frame_and_bad_counts() -> None:
    assert choose_frames(as_frames([scene(1)]), 4).positions.tolist() == [0]
    assert choose_frames(as_frames([np.zeros((9, 9, 3), np.uint8)] * 2), 1).positions.tolist() == [0]
    with pytest.raises(ModelError, match="1 or more"):
        choose_frames(as_frames([scene(1)]), 0)


def test_sharpness_falls_with_blur() -> None:
    images = tuple(cv2.GaussianBlur(scene(30), (0, 0), sigma) for sigma in (0.3, 1.0, 2.0, 4.0))
    sharpness = relative_sharpness(images)
    assert sharpness[0] == 1.0
    assert (np.diff(sharpness) < 0).all()
