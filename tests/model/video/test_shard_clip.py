"""A clip of a dataset is read like a video: its images, nothing of its truth."""

from pathlib import Path

import numpy as np
import pytest

from model.errors import ModelError
from model.video.frames import ReadLimits
from model.video.reading import read_frames
from shards.errors import ShardError
from shards.reader import open_dataset
from tests.shards.synthetic import synthetic_dataset

ALL = ReadLimits(max_frames=64, max_side_px=512)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic_dataset(tmp_path_factory.mktemp("balls"), motions=2, cameras=2, n_frames=5, size_px=48)


def clip_ids(dataset: Path) -> list[str]:
    return [clip.clip_id for clip in open_dataset(dataset).clips()]


@pytest.mark.parametrize("place", ["", "/", "/shards/shard-00000", "/shards/shard-00000/"])
def test_images_are_those_of_the_reader(dataset: Path, place: str) -> None:
    clip_id = clip_ids(dataset)[1]
    frames = read_frames(f"{dataset}{place}#{clip_id}", ALL)
    truth = open_dataset(dataset).read_frames(clip_id)
    assert frames.kind == "clip"
    assert frames.n_source_frames == len(frames) == 5
    for index, frame in enumerate(frames.frames):
        np.testing.assert_array_equal(frame.image, truth.rgb(index))
    assert [frame.time_s for frame in frames.frames] == truth["time_s"].tolist()


def test_limits_and_explicit_frames(dataset: Path) -> None:
    source = f"{dataset}#{clip_ids(dataset)[0]}"
    frames = read_frames(source, ReadLimits(max_frames=2, max_side_px=24))
    assert frames.indices.tolist() == [1, 3]
    assert frames.images[0].shape == (24, 24, 3)
    assert frames.frames[0].source_size == (48, 48)
    assert read_frames(source, ALL, indices=[4, 0]).indices.tolist() == [0, 4]
    with pytest.raises(ModelError, match=r"frame 5 does not exist; expected different indices within 0\.\.4"):
        read_frames(source, ALL, indices=[5])


def test_unknown_clip_suggests_another(dataset: Path) -> None:
    clip_id = clip_ids(dataset)[0]
    with pytest.raises(ModelError) as error:
        read_frames(f"{dataset}#{clip_id[:-1]}x", ALL)
    assert f"Did you mean '{clip_id[:-1]}" in str(error.value)
    with pytest.raises(ModelError, match="one of its 4 clips"):
        read_frames(f"{dataset}#zzzzzz", ALL)


def test_dataset_without_a_clip_names_one(dataset: Path) -> None:
    for place in (str(dataset), f"{dataset}/shards/shard-00000"):
        with pytest.raises(ModelError, match=f"dataset with 4 clips.*#{clip_ids(dataset)[0]}"):
            read_frames(place, ALL)


def test_no_dataset_there(tmp_path: Path) -> None:
    with pytest.raises(ShardError, match="no such file"):
        read_frames(f"{tmp_path}/nothing#clip", ALL)


def test_a_file_with_a_hash_in_its_name_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "take#2.mp4").write_bytes(b"")
    with pytest.raises(ModelError, match="0 bytes"):
        read_frames(tmp_path / "take#2.mp4", ALL)
