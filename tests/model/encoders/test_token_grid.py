"""Feature maps are read where their cells look, not where they lie."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from model.encoders.token_grid import (
    CellCentres,
    cells_per_token,
    detailed_tokens,
    resampled_tokens,
    resized,
)


@given(
    count=st.integers(1, 40),
    grid=st.integers(1, 40),
    shift=st.floats(-0.4, 0.4),
    value=st.floats(-3, 3, allow_nan=False),
)
def test_a_constant_map_stays_constant(count: int, grid: int, shift: float, value: float) -> None:
    centres = CellCentres(first=(0.5 + shift) / count, spacing=1 / count)
    tokens = resampled_tokens(torch.full((1, 2, count, count), value), centres, grid)
    assert tokens.shape == (1, grid * grid, 2)
    torch.testing.assert_close(tokens, torch.full_like(tokens, value))


@pytest.mark.parametrize(("first_px", "stride"), [(4.0, 8), (7.5, 8), (15.5, 16), (31.5, 32), (6.0, 16)])
@pytest.mark.parametrize("grid", [5, 16, 37])
def test_a_ramp_is_read_at_the_centres_of_the_tokens(first_px: float, stride: int, grid: int) -> None:
    size = 256
    centres = CellCentres(first=first_px / size, spacing=stride / size)
    position = (first_px + stride * torch.arange(size // stride)) / size  # what a map of positions would hold
    features = torch.stack(torch.meshgrid(position, position, indexing="xy"))[None]
    tokens = resampled_tokens(features, centres, grid).unflatten(1, (grid, grid))[0]
    expected = (torch.arange(grid) + 0.5) / grid
    reach = max(stride / size, 1 / grid)
    inside = (expected > position[0] + reach) & (expected < position[-1] - reach)
    assert inside.any()
    # Tokens wider than cells take a mean over few cells, whose centre is not exactly the token's.
    tolerance = 1e-6 if 1 / grid <= stride / size else 0.1 / grid
    column, row = tokens[..., 0], tokens[..., 1]
    torch.testing.assert_close(column[0, inside], expected[inside], rtol=0, atol=tolerance)
    torch.testing.assert_close(row[inside, 0], expected[inside], rtol=0, atol=tolerance)


def test_cells_that_are_tokens_pass_unchanged_and_in_row_order() -> None:
    features = torch.randn(2, 3, 8, 8)
    tokens = resampled_tokens(features, CellCentres.aligned(8), 8)
    torch.testing.assert_close(tokens, features.flatten(2).transpose(1, 2))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_resizing_keeps_range_and_leaves_the_right_size_alone(dtype: torch.dtype) -> None:
    images = (torch.rand(1, 3, 64, 64) > 0.5).to(dtype)
    assert resized(images, 64) is images
    small = resized(images, 32)
    assert small.shape == (1, 3, 32, 32)
    assert small.dtype == dtype
    assert 0 <= float(small.min()) <= float(small.max()) <= 1


def test_maps_finer_than_tokens_keep_their_cells_apart() -> None:
    features = torch.arange(2 * 8 * 8.0).reshape(1, 2, 8, 8)
    tokens = detailed_tokens(features, 4).unflatten(1, (4, 4))
    assert cells_per_token(8, 4) == 2
    assert tokens[0, 1, 2].tolist() == features[0, :, 2:4, 4:6].flatten().tolist()
    assert cells_per_token(8, 5) == cells_per_token(4, 8) == 1
    torch.testing.assert_close(
        detailed_tokens(features, 5), resampled_tokens(features, CellCentres.aligned(8), 5)
    )
