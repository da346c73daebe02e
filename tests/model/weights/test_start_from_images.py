"""Published weights begin on what they were trained on: layer-normed image features, and nothing else."""

from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from model.encoders.aggregator import AggregatorConfig, FeatureAggregator
from model.networks.lora import LoraSettings, add_lora
from model.sparse_structure.stage_one import StageOne
from model.weights.importing import import_networks
from model.weights.trellis import stage_one_networks
from model.weights.weight_file import load_start
from tests.model.weights.published import SMALL_VAE, flow_config, write_published

WIDTH, GRID = 16, 2
FLOW = flow_config(channels=WIDTH, blocks=4, mask_blocks=2, heads=2, resolution=2, grid=GRID)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Imported weights: random ones under TRELLIS's names, the cross-attentions of their blocks wide awake."""
    folder = tmp_path_factory.mktemp("published")
    write_published(folder / "TRELLIS", FLOW, SMALL_VAE, std=0.3)
    out = folder / "trellis.safetensors"
    import_networks(folder / "TRELLIS", stage_one_networks(FLOW, SMALL_VAE), out)
    return out


def started(weights: Path, image_channels: int = WIDTH) -> StageOne:
    """A stage 1 before its first step."""
    torch.manual_seed(0)
    sizes = AggregatorConfig(
        image_channels=image_channels,
        image_grid=GRID,
        hand_channels=3,
        hand_grid=GRID,
        hand_width=8,
        hidden=16,
        channels=FLOW.masks.feature_channels,
    )
    network = StageOne(FeatureAggregator(sizes), FLOW)
    load_start(weights, network)
    return network.double()


def draw(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


X_T, T = draw(0, 2, *FLOW.geometry.latent_shape), torch.tensor([0.3, 0.8]).double()


def prenorm_tokens(views: int, seed: int = 1) -> Tensor:
    """What DINOv2 has before its last norm (`x_prenorm`): of any mean and scale."""
    return 1 + 3 * draw(seed, 2, views, GRID**2, WIDTH)


def geometry_of(network: StageOne, prenorm: Tensor, *, hand_seed: int = 2, dropped: bool = False) -> Tensor:
    views, side = prenorm.shape[1], FLOW.masks.mask_resolution
    image = functional.layer_norm(prenorm, prenorm.shape[-1:])  # as `DinoEncoder` gives them
    condition = network.condition(image, draw(hand_seed, 2, views, GRID**2, 3))
    masks_t = draw(3, 2, views, 1, side, side)
    return network.flow(X_T, masks_t, T, condition.unconditional() if dropped else condition).geometry


def published_velocity(network: StageOne, contexts: Tensor) -> Tensor:
    """The geometry branch alone on given contexts, views weighed alike: with one view, TRELLIS's own flow."""
    branch, views = network.flow.geometry, contexts.shape[1]
    y, t = branch.embed(X_T), branch.t_embedder(T)
    for block in branch.blocks:
        y = block(y, t, contexts, torch.full((2, views), 1 / views).double())
    return branch.read_out(y, X_T, T)


@pytest.mark.parametrize("views", [1, 3])
def test_the_geometry_starts_as_the_published_flow_on_layer_normed_image_features(
    weights: Path, views: int
) -> None:
    network, prenorm = started(weights), prenorm_tokens(views)
    expected = published_velocity(network, functional.layer_norm(prenorm, (WIDTH,)))
    # The features are normed twice, with epsilons of 1e-5 and 1e-6; views are weighed in float32.
    torch.testing.assert_close(geometry_of(network, prenorm), expected, atol=1e-5, rtol=1e-5)
    other = geometry_of(network, prenorm_tokens(views, seed=9))
    assert (other - expected).abs().mean() > 0.05 * expected.abs().mean()


def test_hands_and_masks_say_nothing_to_the_geometry_before_the_first_step(weights: Path) -> None:
    network, prenorm = started(weights), prenorm_tokens(2)
    assert torch.equal(geometry_of(network, prenorm, hand_seed=4), geometry_of(network, prenorm))


def test_a_dropped_condition_starts_as_the_published_one(weights: Path) -> None:
    """Contexts of zeros, TRELLIS's neg_cond (FORMATS 4.4), so that guidance works from the start."""
    network = started(weights)
    expected = published_velocity(network, torch.zeros(2, 1, GRID**2, WIDTH).double())
    torch.testing.assert_close(geometry_of(network, prenorm_tokens(1), dropped=True), expected)


def test_adapters_change_nothing_at_the_start(weights: Path) -> None:
    network, prenorm = started(weights), prenorm_tokens(1)
    before = geometry_of(network, prenorm)
    add_lora(network.flow.geometry, LoraSettings(rank=2, alpha=4, dropout=0.0))
    torch.testing.assert_close(geometry_of(network.double(), prenorm), before)


def test_features_of_another_width_reach_the_geometry_through_the_mask_tokens(weights: Path) -> None:
    network = started(weights, image_channels=5)
    tokens, hand = draw(1, 2, 1, GRID**2, 5), draw(2, 2, 1, GRID**2, 3)
    side = FLOW.masks.mask_resolution
    condition = network.condition(tokens, hand)
    assert condition.images is None
    masks_t = draw(3, 2, 1, 1, side, side)
    seen, other = (
        network.flow(X_T, masks_t, T, c).geometry for c in (condition, network.condition(2 - tokens, hand))
    )
    assert (other - seen).abs().mean() > 1e-3 * seen.abs().mean()
