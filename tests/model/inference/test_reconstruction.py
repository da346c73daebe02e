"""reconstruct on real, small networks: closed meshes, equal bits for equal seeds, boxes that stay with their frames."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from model.errors import ModelError
from model.inference.networks import Networks, load_networks, open_stage_one, open_stage_two
from model.inference.reconstruction import STANDARD, Reconstruction, frames_of_images, reconstruct
from model.inference.stage_clock import StageClock
from model.surface.mesh import check_manifold
from model.video.frames import ReadLimits, VideoFrames
from model.video.reading import read_frames


@pytest.fixture(scope="module")
def networks(runs) -> Networks:
    return load_networks(open_stage_one(runs.one), open_stage_two(runs.two), torch.device("cpu"))


@pytest.fixture(scope="module")
def frames(runs) -> VideoFrames:
    return read_frames(f"{runs.dataset}#motion-000000-camera-02", ReadLimits(max_frames=4, max_side_px=64))


@pytest.fixture(scope="module")
def clock() -> StageClock:
    """Of `result`."""
    return StageClock()


@pytest.fixture(scope="module")
def result(frames, networks, clock) -> Reconstruction:
    return reconstruct(frames, networks, clock=clock)


def arrays(result: Reconstruction) -> Iterator[np.ndarray]:
    assert result.surface is not None
    mesh = result.surface.mesh
    yield from (result.images, result.masks, result.occupancy, mesh.vertices, mesh.faces, mesh.colors)


def equal(a: Reconstruction, b: Reconstruction) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(arrays(a), arrays(b), strict=True))


def test_the_surface_is_watertight_and_every_stage_is_timed(result, networks, clock):
    assert result.surface is not None
    assert check_manifold(result.surface.mesh) == result.surface.report
    assert 0 < len(result.voxels) == result.occupancy.sum() < result.occupancy.size
    size = networks.stage_one.image_size
    assert result.images.shape == (4, 3, size, size)
    assert result.masks.shape == (4, size, size)
    assert result.masks.min() >= 0
    assert result.masks.max() <= 1
    assert [name.partition(":")[0] for name in clock.seconds] == [
        "find hand and object",
        "stage 1",
        "stage 2",
        "mesh",
    ]


def test_a_seed_gives_the_same_bits_and_another_one_others(result, frames, networks):
    state = torch.random.get_rng_state()
    torch.rand(3)  # nothing is drawn from the global generator
    assert equal(result, reconstruct(frames, networks))
    torch.random.set_rng_state(state)
    other = reconstruct(frames, networks, replace(STANDARD, seed=1))
    assert not np.array_equal(other.masks, result.masks)
    assert other.seed == 1


def test_without_stage_two_the_rest_is_the_same(result, frames, networks):
    one = reconstruct(frames, replace(networks, stage_two=None))
    assert one.surface is None
    assert np.array_equal(one.occupancy, result.occupancy)
    assert any("stage 1 only" in note for note in one.notes)


def test_images_in_memory_are_the_same_as_read(result, frames, networks):
    from_memory = frames_of_images(frames.images)
    assert equal(result, reconstruct(from_memory, networks))
    with pytest.raises(ModelError, match="no frame"):
        frames_of_images([])


def test_frames_are_cropped_to_their_boxes(frames, networks):
    boxes = [np.array([i, 2.0, 32.0 + i, 34.0]) for i in range(len(frames))]
    settings = replace(STANDARD, closer_crop=None)
    result = reconstruct(frames, replace(networks, stage_two=None), settings, boxes_px=boxes)
    assert len(result.masks) == len(boxes)
    for position, (window, crop) in enumerate(zip(result.windows, result.crops, strict=True)):
        assert window.corner_px == (float(position), 2.0)
        assert crop.origin == "given box"


def test_no_voxel_is_no_object(frames, networks):
    vae = networks.stage_one.task.vae
    bias = vae.decoder.out_layer[2].bias
    kept = bias.clone()
    try:
        bias.data.fill_(-1e4)
        with pytest.raises(ModelError, match="no object found in 4 frames"):
            reconstruct(frames, networks)
    finally:
        bias.data.copy_(kept)


def test_a_clock_adds_up_and_says_what_begins():
    begun: list[str] = []
    clock = StageClock(begun.append)
    for name in ("a", "b", "a"):
        with clock.stage(name):
            pass
    assert begun == ["a", "b", "a"]
    assert list(clock.seconds) == ["a", "b"]
    assert all(value >= 0 for value in clock.seconds.values())
