"""Submanifold convolution against conv3d, and its memory against the number of voxels."""

from collections.abc import Callable

import pytest
import torch
from torch.nn.functional import conv3d

from model.networks.sparse.backends import uses_spconv
from model.networks.sparse.convolution import (
    SparseConv3d,
    convolve_with_pairs,
    convolve_with_spconv,
    pointwise_from_spconv,
)
from model.networks.sparse.grid import SparseGrid
from model.networks.sparse.tensor import SparseTensor
from tests.model.networks.sparse.dense import from_dense, occupancy_of, to_dense


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def _tensor(fraction: float, channels: int = 5, resolution: int = 6) -> SparseTensor:
    occupancy = torch.rand(2, *[resolution] * 3) < fraction
    return from_dense(torch.randn(2, channels, *[resolution] * 3), occupancy)


def _dense(layer: SparseConv3d, volumes: torch.Tensor, occupancy: torch.Tensor) -> torch.Tensor:
    """conv3d on volumes that are zero outside, read where voxels are."""
    weight = layer.conv.weight.permute(0, 4, 1, 2, 3)
    return conv3d(volumes, weight, layer.conv.bias, padding=layer.kernel // 2) * occupancy[:, None]


@pytest.mark.parametrize("fraction", [1.0, 0.3, 0.01])
@pytest.mark.parametrize("kernel", [1, 3, 5])
def test_values_and_gradients_are_those_of_conv3d(fraction: float, kernel: int) -> None:
    layer, x = SparseConv3d(5, 7, kernel), _tensor(fraction)
    features = x.features.clone().requires_grad_()
    ours = to_dense(layer(x.with_features(features)))
    volumes = to_dense(x).requires_grad_()
    dense = _dense(layer, volumes, occupancy_of(x.grid))
    torch.testing.assert_close(ours, dense, atol=1e-5, rtol=1e-5)

    upstream = torch.randn_like(dense)
    grads = torch.autograd.grad((ours * upstream).sum(), [features, *layer.parameters()])
    expected = torch.autograd.grad((dense * upstream).sum(), [volumes, *layer.parameters()])
    at_voxels = from_dense(expected[0], occupancy_of(x.grid)).features
    torch.testing.assert_close(grads[0], at_voxels, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(grads[1:], expected[1:], atol=1e-4, rtol=1e-5)


def test_gradients_are_the_derivatives() -> None:
    x = _tensor(0.4, channels=2, resolution=3)
    inputs = [
        torch.randn(*size, dtype=torch.float64, requires_grad=True)
        for size in [(x.grid.voxels, 2), (3, 3, 3, 3, 2), (3,)]
    ]
    pairs = x.grid.neighbours(3)
    assert torch.autograd.gradcheck(lambda *a: convolve_with_pairs(*a, pairs), inputs)


def test_work_in_steps_is_the_same(shell: Callable[[int], SparseGrid]) -> None:
    """A shell at 64^3 has more pairs than one step takes."""
    grid = shell(64)
    layer, x = SparseConv3d(2, 3, 3), SparseTensor(grid=grid, features=torch.randn(grid.voxels, 2))
    assert max(len(rows) for rows, _ in grid.neighbours(3).before_middle) > 8192
    dense = _dense(layer, to_dense(x), occupancy_of(grid))
    torch.testing.assert_close(to_dense(layer(x)), dense, atol=1e-5, rtol=1e-5)


def test_samples_do_not_see_each_other() -> None:
    layer, x = SparseConv3d(5, 5, 3), _tensor(0.5)
    first = x.grid.batch_index == 0
    changed = x.with_features(torch.where(first[:, None], x.features, torch.randn_like(x.features)))
    assert torch.equal(layer(changed).features[first], layer(x).features[first])


def test_autocast_multiplies_in_bfloat16_and_adds_in_float32() -> None:
    layer, x = SparseConv3d(64, 8, 3), _tensor(1.0, channels=64)
    exact = layer(x).features
    with torch.autocast("cpu", torch.bfloat16):
        rounded = layer(x)
    assert rounded.features.dtype == torch.bfloat16
    torch.testing.assert_close(rounded.features.float(), exact, atol=0.02, rtol=0.02)
    rounded.features.float().sum().backward()
    assert layer.conv.weight.grad is not None
    assert layer.conv.weight.grad.dtype == torch.float32


def test_memory_is_that_of_one_copy_of_the_features(
    shell: Callable[[int], SparseGrid], memory_of: Callable
) -> None:
    """Kept for the gradient: inputs and weights. Never made: 27 rows per voxel, or a volume."""
    layer = SparseConv3d(16, 16, 3)
    weights = layer.conv.weight.nbytes
    for resolution in (16, 48):
        memory = memory_of(layer, shell(resolution), channels=16)
        features = memory.voxels * 16 * 4
        assert memory.kept_for_gradient == features + weights
        assert memory.largest_tensor == max(features, weights)


def test_pointwise_weights_of_spconv_are_read_as_it_multiplies() -> None:
    published, x = torch.randn(4, 1, 1, 1, 6), torch.randn(3, 6)
    ours = pointwise_from_spconv(published)
    torch.testing.assert_close(x @ ours[:, 0, 0, 0].T, x @ published.view(6, 4))


def test_the_pure_path_runs_without_a_gpu() -> None:
    assert not uses_spconv(torch.zeros(1, 1))


@pytest.mark.parametrize("kernel", [3, 5])
def test_spconv_gives_the_same_numbers(kernel: int) -> None:
    """Forward only: spconv's gradient needs CUDA even for CPU tensors."""
    pytest.importorskip("spconv.pytorch")
    layer, x = SparseConv3d(5, 7, kernel), _tensor(0.3)
    state = torch.get_rng_state()
    for _ in range(2):  # the second time with the pairs kept
        theirs = convolve_with_spconv(x.grid, x.features, layer.conv.weight, layer.conv.bias)
        torch.testing.assert_close(theirs, layer(x).features, atol=1e-5, rtol=1e-5)
    assert torch.equal(state, torch.get_rng_state())


def test_spconv_multiplies_pointwise_as_written_here() -> None:
    spconv = pytest.importorskip("spconv.pytorch")
    theirs, x = spconv.SubMConv3d(5, 7, 1), _tensor(0.3)
    index = torch.cat([x.grid.batch_index[:, None], x.grid.coordinates], dim=1).int()
    out = theirs(spconv.SparseConvTensor(x.features, index, [6] * 3, 2)).features
    ours = SparseConv3d(5, 7, 1)
    weight = pointwise_from_spconv(theirs.weight.detach())
    ours.conv.load_state_dict({"weight": weight, "bias": theirs.bias.detach()})
    torch.testing.assert_close(ours(x).features, out, atol=1e-5, rtol=1e-5)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_spconv_and_pairs_agree_on_a_gpu() -> None:
    pytest.importorskip("spconv.pytorch")
    layer, x = SparseConv3d(16, 32, 3).cuda(), _tensor(0.3, channels=16).to(torch.device("cuda"))
    weight, bias = layer.conv.weight, layer.conv.bias
    results = []
    for run in (
        lambda features: convolve_with_spconv(x.grid, features, weight, bias),
        lambda features: convolve_with_pairs(features, weight, bias, x.grid.neighbours(3)),
    ):
        features = x.features.clone().requires_grad_()
        out = run(features)
        results.append([out, *torch.autograd.grad(out.square().sum(), [features, weight, bias])])
    torch.testing.assert_close(*results, atol=1e-3, rtol=1e-3)
