"""What a surface decoder says about its active voxels, in the layout of TRELLIS.

Layout of the 101 channels of `slat_dec_mesh` (microsoft/TRELLIS, trellis/representations/mesh/cube2mesh.py,
utils_cube.py and the FlexiCubes it calls, read at the copy in gmum/STAGE @d62cb3f):

    0:8     signed distance of the 8 corners, negative inside; -1/resolution is added to what the network emits
    8:32    deformation of the 8 corners, xyz each; a corner moves by tanh(deformation) (1 - 1e-8) / (2 resolution)
    32:53   FlexiCubes weights: beta of 12 edges, alpha of 8 corners, gamma
    53:101  colour of the 8 corners, rgb and normal each; colour = sigmoid

Corner c of voxel (i, j, k) is the lattice point (i + (c & 1), j + (c >> 1 & 1), k + (c >> 2 & 1)). Values of a corner
that several active voxels share are averaged *before* tanh and sigmoid. The FlexiCubes weights are not used here:
they place one vertex per cell, and cells with two sheets then share edges four times, which is not manifold.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from model.errors import ModelError

__all__ = ["CHANNELS", "CORNERS", "SurfaceChannels", "SurfaceFields", "split_channels", "surface_fields"]

CHANNELS = 101
CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])


@dataclass(frozen=True, kw_only=True)
class SurfaceChannels:
    """The 101 channels by name, before any averaging; differentiable views of the decoder's output."""

    distances: Float[Tensor, "voxel 8"]  # biased; negative inside
    deformations: Float[Tensor, "voxel 8 3"]  # before tanh
    weights: Float[Tensor, "voxel 21"]  # FlexiCubes: beta 12, alpha 8, gamma 1
    color_logits: Float[Tensor, "voxel 8 3"]  # before sigmoid; sRGB
    normal_logits: Float[Tensor, "voxel 8 3"]  # before sigmoid


@dataclass(frozen=True, kw_only=True)
class SurfaceFields:
    """A decoder's word on the active voxels of a resolution^3 grid over the canonical cube [-0.5, 0.5]^3."""

    resolution: int
    voxels: Int[np.ndarray, "voxel 3"]  # (i, j, k) along (x, y, z), unique
    distances: Float32[np.ndarray, "voxel 8"]  # negative inside, any unit
    deformations: Float32[np.ndarray, "voxel 8 3"]  # before tanh
    color_logits: Float32[np.ndarray, "voxel 8 3"]  # before sigmoid; sRGB

    def __post_init__(self) -> None:
        if not len(self.voxels):
            raise ModelError(
                "surface fields",
                "no active voxel",
                expected="at least one",
                action="The structure stage found no object: use other frames or a crop nearer to the object.",
            )
        if self.voxels.min() < 0 or self.voxels.max() >= self.resolution:
            raise ModelError(
                "surface fields",
                f"voxels reach from {self.voxels.min()} to {self.voxels.max()}",
                expected=f"0..{self.resolution - 1} at resolution {self.resolution}",
                action="Pass the resolution of the decoder's output, not of its input.",
            )
        x, y, z = self.voxels.astype(np.int64).T
        twice = len(x) - len(np.unique((x * self.resolution + y) * self.resolution + z))
        if twice:
            raise ModelError(
                "surface fields",
                f"{twice} voxels come twice",
                expected="each voxel once",
                action="Pass one object at a time.",
            )
        for name in ("distances", "deformations", "color_logits"):
            wrong = int(np.count_nonzero(~np.isfinite(getattr(self, name))))
            if wrong:
                raise ModelError(
                    "surface fields",
                    f"{wrong} values of {name} are not finite",
                    expected="finite numbers",
                    action="Decode in float32, or check the checkpoint.",
                )


def split_channels(channels: Float[Tensor, "voxel channel"], resolution: int) -> SurfaceChannels:
    """The decoder's channels by name, with the distance bias of -1/resolution added. ModelError: not 101 channels."""
    if channels.shape[1] != CHANNELS:
        raise ModelError(
            "surface channels",
            f"{channels.shape[1]} channels",
            expected=f"{CHANNELS} (8 distances, 24 deformations, 21 weights, 48 colours)",
            action="Use a mesh decoder with colour.",
        )
    distances, deformations, weights, colors = channels.split([8, 24, 21, 48], dim=1)
    colors = colors.unflatten(1, (8, 6))
    return SurfaceChannels(
        distances=distances - 1.0 / resolution,
        deformations=deformations.unflatten(1, (8, 3)),
        weights=weights,
        color_logits=colors[..., :3],
        normal_logits=colors[..., 3:],
    )


def surface_fields(
    voxels: Int[Tensor, "voxel 3"], channels: Float[Tensor, "voxel 101"], resolution: int
) -> SurfaceFields:
    """The decoder's output for one object, ready for extraction; float32 on the CPU."""
    named = split_channels(channels.detach().to("cpu", torch.float32), resolution)
    return SurfaceFields(
        resolution=resolution,
        voxels=voxels.cpu().numpy(),
        distances=named.distances.numpy(),
        deformations=named.deformations.numpy(),
        color_logits=named.color_logits.numpy(),
    )
