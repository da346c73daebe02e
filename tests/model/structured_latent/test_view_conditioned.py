"""Stage 2 as a module: condition per view, learned fusion weights, condition dropping."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from model.encoders.aggregator import AggregatorConfig, FeatureAggregator
from model.networks.transformer import layer_norm
from model.structured_latent.flow import SlatFlow
from model.structured_latent.vae.latent import LatentNormalisation
from model.structured_latent.view_conditioned import ViewConditionedSlatFlow
from tests.model.structured_latent.small_slat import FLOW, trained, voxels, without_gradient

T = torch.tensor([0.3, 0.8]).double()


def _untrained(image_channels: int = 12) -> ViewConditionedSlatFlow:
    torch.manual_seed(0)
    aggregator = AggregatorConfig(
        image_channels=image_channels,
        image_grid=3,
        hand_channels=6,
        hand_grid=2,
        hand_width=5,
        hidden=16,
        channels=14,
    )
    stage_two = ViewConditionedSlatFlow(
        FeatureAggregator(aggregator), SlatFlow(FLOW), LatentNormalisation.identity(4)
    )
    return stage_two.double()


def _stage_two(image_channels: int = 12) -> ViewConditionedSlatFlow:
    network = trained(_untrained(image_channels))
    assert isinstance(network, ViewConditionedSlatFlow)
    return network


def _features(views: int, image_channels: int = 12) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(7)
    image = torch.randn(2, views, 9, image_channels, generator=generator, dtype=torch.float64)
    return image, torch.randn(2, views, 4, 6, generator=generator, dtype=torch.float64)


def test_the_condition_starts_as_layer_normed_image_features_with_equal_weights() -> None:
    image, hand = _features(4)
    condition = _untrained().condition(image, hand)
    assert torch.equal(condition.contexts, layer_norm(image))
    assert torch.equal(condition.weights, torch.full((2, 4), 0.25))


@pytest.mark.parametrize("image_channels", [12, 8])
def test_hand_position_and_weights_are_learned(image_channels: int) -> None:
    """Image features as wide as the condition, and others."""
    network, (image, hand) = _stage_two(image_channels), _features(4, image_channels)
    condition = network.condition(image, hand)
    torch.testing.assert_close(condition.weights.sum(1), torch.ones(2))
    assert condition.weights.std() > 1e-3
    assert not torch.allclose(network.condition(image, hand.roll(1, 0)).contexts, condition.contexts)
    # Nothing else tells the places of an image apart when the hand features are equal everywhere.
    even = hand[:, :, :1].expand(-1, -1, 4, -1)
    turned = network.condition(image.flip(2), even).contexts.flip(2)
    assert not torch.allclose(turned, network.condition(image, even).contexts)


@pytest.mark.parametrize("build", [_untrained, _stage_two])
def test_order_of_views_does_not_matter(build: Callable[[], ViewConditionedSlatFlow]) -> None:
    network, x, order = build(), voxels(0.2, 4), [2, 0, 3, 1]
    image, hand = _features(4)
    straight = network(x, T, network.condition(image, hand))
    permuted = network(x, T, network.condition(image[:, order], hand[:, order]))
    torch.testing.assert_close(permuted.features, straight.features, atol=1e-6, rtol=1e-6)


def test_identical_views_equal_one_view() -> None:
    network, x, (image, hand) = _stage_two(), voxels(0.2, 4), _features(1)
    one = network(x, T, network.condition(image, hand))
    five = network(
        x, T, network.condition(image.expand(-1, 5, -1, -1).clone(), hand.expand(-1, 5, -1, -1).clone())
    )
    # Float32 softmax weights of five equal scores: 0.2 to 1e-8.
    torch.testing.assert_close(five.features, one.features, atol=1e-6, rtol=1e-6)


def test_dropping_takes_the_condition_from_these_samples_only() -> None:
    network, x = _stage_two(), voxels(0.2, 4)
    image, hand = _features(3)
    condition = network.condition(image, hand)
    straight = network(x, T, condition).features.split(x.grid.sample_sizes)
    dropped = network(x, T, condition.dropped(torch.tensor([True, False]))).features
    nothing = network(x, T, condition.unconditional()).features
    assert not torch.allclose(dropped[: x.grid.sample_sizes[0]], straight[0])
    torch.testing.assert_close(dropped[: x.grid.sample_sizes[0]], nothing[: x.grid.sample_sizes[0]])
    torch.testing.assert_close(dropped[x.grid.sample_sizes[0] :], straight[1])
    # Without condition it makes no difference which views there were.
    other = network(x, T, network.condition(2 * image.flip(1), hand).unconditional()).features
    torch.testing.assert_close(nothing, other, atol=1e-6, rtol=1e-6)


def test_an_infinite_feature_does_not_survive_dropping() -> None:
    network, (image, hand) = _stage_two(), _features(3)
    image[0, 0, 0, 0] = torch.inf
    dropped = network.condition(image, hand).dropped(torch.tensor([True, False]))
    assert not dropped.contexts[0].any()


@pytest.mark.parametrize("image_channels", [12, 8])
def test_gradients_reach_every_parameter(image_channels: int) -> None:
    network = _stage_two(image_channels)
    condition = network.condition(*_features(3, image_channels))
    network(voxels(0.2, 4), T, condition).features.square().mean().backward()
    # A constant added to every view's score changes no weight.
    assert without_gradient(network) in ([], ["fusion.score.2.bias"])


def test_the_normalisation_is_saved_and_the_positions_are_not() -> None:
    names = set(_untrained().state_dict())
    assert {"normalisation.mean", "normalisation.std"} < names
    assert "context.pos_emb" not in names


def test_bfloat16_autocast_stays_close() -> None:
    network, x = _stage_two().float(), voxels(0.2, 4)
    image, hand = (part.float() for part in _features(3))
    x, t = x.with_features(x.features.float()), T.float()
    exact = network(x, t, network.condition(image, hand)).features
    with torch.autocast("cpu", torch.bfloat16):
        found = network(x, t, network.condition(image, hand)).features
    assert (found.float() - exact).norm() < 0.04 * exact.norm()
