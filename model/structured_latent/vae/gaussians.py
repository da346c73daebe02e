"""What a gaussian decoder says about its voxels, in the layout of slat_dec_gs_swin8_B_64l8gs32.

Channels of a voxel, 32 gaussians each (microsoft/TRELLIS, decoder_gs.py and gaussian_model.py @c6acc1f):

    0:96      offset from the voxel's centre, xyz; tanh(offset + perturbation) * 1.5 / (2 resolution)
    96:192    features_dc, rgb; colour = 0.5 + features_dc / (2 sqrt(pi)), spherical harmonics of degree 0
    192:288   scaling; sqrt(softplus(scaling + softplus^-1(0.004))^2 + 0.0009^2)
    288:416   rotation, wxyz; normalise(0.1 rotation + (1, 0, 0, 0))
    416:448   opacity; sigmoid(opacity + sigmoid^-1(0.1))
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from model.errors import ModelError
from model.networks.sparse.tensor import SparseTensor

__all__ = [
    "GAUSSIANS_PER_VOXEL",
    "GAUSSIAN_CHANNELS",
    "GaussianChannels",
    "Gaussians",
    "gaussians",
    "offset_perturbation",
    "split_gaussian_channels",
]

GAUSSIANS_PER_VOXEL = 32
_WIDTHS = (3, 3, 3, 4, 1)
GAUSSIAN_CHANNELS = GAUSSIANS_PER_VOXEL * sum(_WIDTHS)
_VOXEL_SIZE = 1.5  # how far centres reach: this many voxels, so neighbours overlap
_SCALE, _MINIMUM_SCALE = 4e-3, 9e-4  # of the cube's side
_OPACITY = 0.1
_ROTATION_RATE = 0.1


@dataclass(frozen=True, kw_only=True)
class GaussianChannels:
    """The decoder's output by name, before any activation."""

    offset: Float[Tensor, "voxel 32 3"]
    features_dc: Float[Tensor, "voxel 32 3"]
    scaling: Float[Tensor, "voxel 32 3"]
    rotation: Float[Tensor, "voxel 32 4"]
    opacity: Float[Tensor, "voxel 32 1"]


@dataclass(frozen=True, kw_only=True)
class Gaussians:
    """Gaussians in the canonical frame [-0.5, 0.5]^3, rows in the order of the voxels they come from."""

    centers: Float[Tensor, "gaussian 3"]
    colors: Float[Tensor, "gaussian 3"]  # sRGB, about 0..1, not clipped
    scales: Float[Tensor, "gaussian 3"]  # standard deviations along the gaussian's own axes
    rotations_wxyz: Float[Tensor, "gaussian 4"]  # unit quaternions
    opacities: Float[Tensor, " gaussian"]  # 0..1


def split_gaussian_channels(channels: Float[Tensor, "voxel channel"]) -> GaussianChannels:
    """The decoder's channels by name. ModelError: not 448 channels."""
    if channels.shape[1] != GAUSSIAN_CHANNELS:
        raise ModelError(
            "gaussian channels",
            f"{channels.shape[1]} channels",
            expected=f"{GAUSSIAN_CHANNELS} ({GAUSSIANS_PER_VOXEL} gaussians of {sum(_WIDTHS)})",
            action="Use the output of a gaussian decoder.",
        )
    parts = channels.split([GAUSSIANS_PER_VOXEL * width for width in _WIDTHS], dim=1)
    offset, features_dc, scaling, rotation, opacity = (
        part.unflatten(1, (GAUSSIANS_PER_VOXEL, -1)) for part in parts
    )
    return GaussianChannels(
        offset=offset, features_dc=features_dc, scaling=scaling, rotation=rotation, opacity=opacity
    )


def gaussians(decoded: SparseTensor, perturbation: Float[Tensor, "32 3"]) -> list[Gaussians]:
    """The gaussians of each sample, float32; `perturbation` is the decoder's `offset_perturbation`."""
    named = split_gaussian_channels(decoded.features.float())
    resolution = decoded.grid.resolution
    voxel_centers = (decoded.grid.coordinates + 0.5) / resolution - 0.5
    reach = 0.5 * _VOXEL_SIZE / resolution
    centers = voxel_centers[:, None] + reach * torch.tanh(named.offset + perturbation.float())
    scales = functional.softplus(named.scaling + math.log(math.expm1(_SCALE)))
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0], device=centers.device)
    whole = {
        "centers": centers,
        "colors": 0.5 + named.features_dc / (2 * math.sqrt(math.pi)),
        "scales": (scales.square() + _MINIMUM_SCALE**2).sqrt(),
        "rotations_wxyz": functional.normalize(_ROTATION_RATE * named.rotation + upright, dim=-1),
        "opacities": torch.sigmoid(named.opacity[..., 0] + math.log(_OPACITY / (1 - _OPACITY))),
    }
    split = {name: values.split(decoded.grid.sample_sizes) for name, values in whole.items()}
    return [
        Gaussians(**{name: parts[i].flatten(0, 1) for name, parts in split.items()})
        for i in range(decoded.grid.batch_size)
    ]


def offset_perturbation() -> Float[Tensor, "32 3"]:
    """Offsets that the gaussians of a voxel start from: Hammersley points in its cube, before tanh.

    Point i is (i / 32, i's bits mirrored at the binary point, the same in base 3).
    """
    points = [
        [i / GAUSSIANS_PER_VOXEL, _radical_inverse(2, i), _radical_inverse(3, i)]
        for i in range(GAUSSIANS_PER_VOXEL)
    ]
    return torch.atanh((2 * torch.tensor(points) - 1) / _VOXEL_SIZE)


def _radical_inverse(base: int, number: int) -> float:
    value, place = 0.0, 1.0 / base
    while number:
        number, digit = divmod(number, base)
        value += digit * place
        place /= base
    return value
