"""Hand and image features joined, patch by patch."""

from dataclasses import replace

import pytest
import torch

from model.encoders.aggregator import AggregatorConfig, FeatureAggregator

PAPER = AggregatorConfig(
    image_channels=1024,
    image_grid=37,
    hand_channels=1280,
    hand_grid=14,
    hand_width=1024,
    hidden=2048,
    channels=1024,
)
SMALL = AggregatorConfig(
    image_channels=6, image_grid=16, hand_channels=5, hand_grid=8, hand_width=4, hidden=12, channels=7
)


def test_the_papers_channels() -> None:
    with torch.device("meta"):
        aggregator = FeatureAggregator(PAPER)
        tokens = aggregator(torch.empty(1, 2, 1369, 1024), torch.empty(1, 2, 196, 1280))
    assert tokens.shape == (1, 2, 1369, 1024)
    assert aggregator.mlp[0].weight.shape == (2048, 2048)


@pytest.mark.parametrize(("image_grid", "hand_grid"), [(16, 8), (8, 8), (8, 16), (37, 14)])
def test_shapes_and_gradients(image_grid: int, hand_grid: int) -> None:
    config = AggregatorConfig(**{**vars(SMALL), "image_grid": image_grid, "hand_grid": hand_grid})
    aggregator = FeatureAggregator(config)
    tokens = aggregator(torch.randn(2, 3, image_grid**2, 6), torch.randn(2, 3, hand_grid**2, 5))
    assert tokens.shape == (2, 3, image_grid**2, 7)
    assert aggregator.grid == image_grid
    tokens.square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in aggregator.parameters())


def test_a_hand_token_reaches_the_image_tokens_over_it() -> None:
    torch.manual_seed(0)
    aggregator = FeatureAggregator(SMALL)
    image, hand = torch.zeros(1, 1, 256, 6), torch.zeros(1, 1, 64, 5)
    row, column = 2, 5
    lit = hand.clone()
    lit[0, 0, row * 8 + column] = 3.0
    with torch.no_grad():
        change = (aggregator(image, lit) - aggregator(image, hand))[0, 0].norm(dim=-1).unflatten(0, (16, 16))
    places = (torch.arange(16) + 0.5) / 16
    weight = (change > 1e-6).float()
    seen = torch.stack([(weight.sum(1) * places).sum(), (weight.sum(0) * places).sum()]) / weight.sum()
    torch.testing.assert_close(seen, torch.tensor([(row + 0.5) / 8, (column + 0.5) / 8]), rtol=0, atol=0.01)


def test_an_image_token_reaches_only_itself() -> None:
    aggregator = FeatureAggregator(SMALL)
    image, hand = torch.zeros(1, 1, 256, 6), torch.randn(1, 1, 64, 5)
    lit = image.clone()
    lit[0, 0, 77] = 1.0
    change = (aggregator(lit, hand) - aggregator(image, hand))[0, 0].abs().sum(-1)
    assert change.nonzero().flatten().tolist() == [77]


def test_shifting_both_features_shifts_the_tokens() -> None:
    torch.manual_seed(0)
    aggregator = FeatureAggregator(SMALL)
    image, hand = torch.randn(16, 16, 6), torch.randn(8, 8, 5)

    def fused(image: torch.Tensor, hand: torch.Tensor) -> torch.Tensor:
        tokens = aggregator(image.flatten(0, 1)[None, None], hand.flatten(0, 1)[None, None])
        return tokens[0, 0].unflatten(0, (16, 16))

    plain = fused(image, hand)
    shifted = fused(image.roll(2, 1), hand.roll(1, 1))
    torch.testing.assert_close(shifted[:, 8:12], plain[:, 6:10])


@pytest.mark.parametrize("hand_grid", [8, 16, 24])
def test_bfloat16_of_a_coarser_an_equal_and_a_finer_hand_grid(hand_grid: int) -> None:
    torch.manual_seed(0)
    aggregator = FeatureAggregator(replace(SMALL, hand_grid=hand_grid))
    image, hand = torch.randn(1, 1, 256, 6), torch.randn(1, 1, hand_grid**2, 5)
    exact = aggregator(image, hand)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = aggregator(image, hand)
    half = aggregator.bfloat16()(image.bfloat16(), hand.bfloat16())
    assert mixed.dtype == half.dtype == torch.bfloat16
    for tokens in (mixed, half):
        torch.testing.assert_close(tokens.float(), exact, rtol=0, atol=0.02)
