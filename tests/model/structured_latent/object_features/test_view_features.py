"""Features of views: made once, kept on the disk under all that decides them, and those of the mirrored object."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel

from model.data.batch import Batch, join_surfaces
from model.data.crop import mirrored_surface
from model.encoders.cached import CachedEncoder
from model.encoders.dino import DinoConfig, DinoEncoder
from model.encoders.efficientnet import EfficientNetConfig, load_efficientnet
from model.errors import ModelError
from model.structured_latent.object_features.object_input import ObjectInputs
from model.structured_latent.object_features.object_mesh import ObjectMeshes
from model.structured_latent.object_features.view_encoder import ViewEncoder, view_encoder
from model.structured_latent.object_features.view_features import ViewFeatures, ViewFeaturesConfig
from shards.reader import open_dataset
from shards.schema import ObjectRow
from tests.model.data.balls import uid_of_split
from tests.model.encoders.mean_color import MeanColor
from tests.model.structured_latent.object_features.textured_ball import write_textured_balls
from tests.model.structured_latent.watertight_shapes import batch_of, surface_of

UID = uid_of_split("train", 0)
CPU = torch.device("cpu")
CHANNELS = 568


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> dict[bool, Path]:
    """The same dataset with meshes and without."""
    root = tmp_path_factory.mktemp("data")
    return {held: write_textured_balls(root / str(held), with_meshes=held) for held in (True, False)}


@pytest.fixture(scope="module")
def encoder() -> ViewEncoder:
    return view_encoder(load_efficientnet(EfficientNetConfig(image_size=64, grid=8)))


@pytest.fixture(scope="module")
def occupancy(data: dict[bool, Path]) -> np.ndarray:
    grid = np.zeros((64, 64, 64), bool)
    grid[tuple(row_of(data[True]).occupancy_64.T)] = True
    grid[40:] = False  # not its own mirror image
    return grid


def row_of(root: Path) -> ObjectRow:
    return next(row for row in open_dataset(str(root)).objects() if row.object_uid == UID)


def features(root: Path, encoder: ViewEncoder, cache: Path | None, *, views: int = 3) -> ViewFeatures:
    return ViewFeatures(
        meshes=ObjectMeshes(shards=open_dataset(str(root)).shards),
        encoder=encoder,
        config=ViewFeaturesConfig(views=views, image_size=64, supersampling=1, cache=cache),
        device=CPU,
    )


def test_what_is_in_the_cache_needs_no_mesh(data, encoder, occupancy, tmp_path) -> None:
    made = features(data[True], encoder, tmp_path)
    rows = made.rows(UID, occupancy, is_mirrored=False)
    assert rows.shape == (occupancy.sum(), CHANNELS)
    assert rows.dtype == torch.float16
    assert rows.std() > 0.1
    (path,) = tmp_path.rglob("*.safetensors")
    before = path.stat().st_mtime_ns
    again = features(data[False], encoder, tmp_path)
    for is_mirrored, shape in ((False, occupancy), (True, occupancy[::-1])):
        expected = made.rows(UID, shape, is_mirrored=is_mirrored)
        assert torch.equal(again.rows(UID, shape, is_mirrored=is_mirrored), expected)
    assert path.stat().st_mtime_ns == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # nothing half-written


def test_without_a_folder_memory_keeps_them(data, encoder, occupancy) -> None:
    made = features(data[True], encoder, None)
    rows = made.rows(UID, occupancy, is_mirrored=False)
    assert made.rows(UID, occupancy, is_mirrored=False) is rows
    with pytest.raises(ModelError, match="its licence forbids copies"):
        features(data[False], encoder, None).rows(UID, occupancy, is_mirrored=False)


def test_the_mirrored_object_has_the_features_of_its_mirrored_images(data, occupancy) -> None:
    """With an encoder that gives colours, a voxel of the mirrored object has those of its mirror image."""
    colors = ViewEncoder(encoder=MeanColor(4), digest="colours")
    made = features(data[True], colors, None)
    plain, there = (
        made.rows(UID, shape, is_mirrored=is_mirrored)
        for shape, is_mirrored in ((occupancy, False), (occupancy[::-1], True))
    )
    grids = []
    for shape, rows in ((occupancy, plain), (occupancy[::-1], there)):
        grid = torch.zeros(64, 64, 64, 3, dtype=torch.float16)
        grid[torch.from_numpy(shape.copy())] = rows
        grids.append(grid)
    torch.testing.assert_close(grids[1].flip(0), grids[0], atol=2e-3, rtol=0)
    assert (plain.float() - there.float()).abs().max() > 0.01


def test_everything_that_decides_them_is_in_the_name(data, encoder, occupancy, tmp_path) -> None:
    fewer = occupancy.copy()
    fewer[tuple(np.argwhere(fewer)[0])] = False
    other = load_efficientnet(EfficientNetConfig(image_size=64, grid=8))
    with torch.no_grad():
        next(other.pyramid.parameters()).mul_(1.01)
    for number, (made, shape) in enumerate(
        [
            (features(data[True], encoder, tmp_path), occupancy),
            (features(data[True], encoder, tmp_path), fewer),
            (features(data[True], encoder, tmp_path, views=2), occupancy),
            (features(data[True], view_encoder(other), tmp_path), occupancy),
        ]
    ):
        made.rows(UID, shape, is_mirrored=False)
        assert len(list(tmp_path.rglob("*.safetensors"))) == number + 1


def test_a_damaged_file_is_named_and_not_used(data, encoder, occupancy, tmp_path) -> None:
    features(data[True], encoder, tmp_path).rows(UID, occupancy, is_mirrored=False)
    (path,) = tmp_path.rglob("*.safetensors")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ModelError, match="Delete it: it is made again"):
        features(data[True], encoder, tmp_path).rows(UID, occupancy, is_mirrored=False)


def test_autocast_does_not_change_what_is_kept(data, encoder, occupancy) -> None:
    plain = features(data[True], encoder, None).rows(UID, occupancy, is_mirrored=False)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = features(data[True], encoder, None).rows(UID, occupancy, is_mirrored=False)
    assert torch.equal(inside, plain)


def test_samples_of_a_batch_get_the_features_of_their_objects(data, encoder, occupancy) -> None:
    """The second sample is the first in a mirror: `is_mirrored` travels from the stream to the features."""
    surface = surface_of(row_of(data[True]))
    both = [surface, mirrored_surface(surface)]
    shapes = [occupancy, np.ascontiguousarray(occupancy[::-1])]
    batch = Batch(**vars(batch_of(*zip(both, shapes))) | {"surface": join_surfaces(both, [UID, UID])})
    made = features(data[True], encoder, None)
    found = ObjectInputs(of_views=made)(batch).features
    assert found.features.dtype == torch.float32
    for place, (shape, is_mirrored) in enumerate(zip(shapes, (False, True))):
        expected = made.rows(UID, shape, is_mirrored=is_mirrored).float()
        assert torch.equal(found.features[found.grid.batch_index == place], expected)


def test_dinos_tokens_are_read_before_their_last_norm() -> None:
    """Layer-normed, they are what conditions; an encoder of another kind is refused."""
    network = Dinov2WithRegistersModel(
        Dinov2WithRegistersConfig(
            hidden_size=24, num_hidden_layers=2, num_attention_heads=2, image_size=56, patch_size=14
        )
    )
    dino = DinoEncoder(
        network=network.eval().requires_grad_(False),
        normed=True,
        config=DinoConfig(source="none", image_size=56, local_files_only=True),
    )
    made = view_encoder(CachedEncoder(encoder=dino, max_views=2))
    images = torch.rand(1, 2, 3, 56, 56, generator=torch.Generator().manual_seed(0))
    tokens = made.encoder(images)
    assert (made.encoder.grid, made.encoder.channels) == (4, 24)
    assert not torch.allclose(tokens, dino(images))
    torch.testing.assert_close(nn.functional.layer_norm(tokens, (24,)), dino(images))
    other = replace(dino, config=replace(dino.config, image_size=42))
    assert view_encoder(other).digest != made.digest
    with pytest.raises(ModelError, match="MeanColor"):
        view_encoder(MeanColor(4))
