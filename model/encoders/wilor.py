"""The paper's hand prior: the ViT of WiLoR (FORMATS 5), run on the same whole crop as the image encoder.

WiLoR cuts its own box around a hand and mirrors left ones; here the crop holds hand and object, so tokens
stay aligned with the image tokens, and left hands are shown as they are (DECISIONS: "WiLoR sees the whole
crop"). The paper names 224 x 224 and 1024 channels, neither of which is WiLoR's (256 x 192, 1280): the position
embedding is interpolated from 16 x 12 patches to 14 x 14, and the aggregator projects 1280 channels.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from model.encoders.checkpoint import load_state_dict
from model.encoders.token_grid import CellCentres, resampled_tokens, resized
from model.errors import ModelError
from shards.settings import Range

__all__ = [
    "WILOR_LAYOUT",
    "WilorBackbone",
    "WilorConfig",
    "WilorEncoder",
    "WilorKeys",
    "WilorLayout",
    "load_wilor",
]

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # ImageNet, sRGB
_PADDING = 2  # pixels around the image before cutting patches, whatever the patch
_DECODER = ("decpose.", "decshape.", "deccam.")  # read the tokens out as MANO parameters
_ACTION = (
    "Download pretrained_models/wilor_final.ckpt as the WiLoR repository says (2.5 GB, CC BY-NC-ND) and give its "
    "path, or choose the open hand encoder."
)


@dataclass(frozen=True, kw_only=True)
class WilorLayout:
    """Sizes of the network. Image sizes are what its position embedding was made for, in pixels."""

    image_height: Annotated[int, Range(8, 8192)]
    image_width: Annotated[int, Range(8, 8192)]
    patch: Annotated[int, Range(1, 65_536)]
    channels: Annotated[int, Range(1, 65_536)]
    depth: Annotated[int, Range(1, 65_536)]
    heads: Annotated[int, Range(1, 65_536)]
    mlp_ratio: Annotated[int, Range(1, 65_536)]
    joints: Annotated[int, Range(1, 65_536)]
    """Joints with a pose token: wrist and 15."""

    @property
    def patch_grid(self) -> tuple[int, int]:
        """Rows and columns of the position embedding."""
        return self.image_height // self.patch, self.image_width // self.patch


WILOR_LAYOUT = WilorLayout(
    image_height=256, image_width=192, patch=16, channels=1280, depth=32, heads=16, mlp_ratio=4, joints=16
)
"""The published network, 631 M parameters."""


class _Attention(nn.Module):
    def __init__(self, layout: WilorLayout) -> None:
        super().__init__()
        self.heads = layout.heads
        self.qkv = nn.Linear(layout.channels, 3 * layout.channels)
        self.proj = nn.Linear(layout.channels, layout.channels)

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(q, k, v)
        return self.proj(mixed.transpose(1, 2).flatten(2))


class _Mlp(nn.Module):
    def __init__(self, layout: WilorLayout) -> None:
        super().__init__()
        self.fc1 = nn.Linear(layout.channels, layout.mlp_ratio * layout.channels)
        self.fc2 = nn.Linear(layout.mlp_ratio * layout.channels, layout.channels)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(functional.gelu(self.fc1(x)))


class _Block(nn.Module):
    def __init__(self, layout: WilorLayout) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(layout.channels, eps=1e-6)
        self.attn = _Attention(layout)
        self.norm2 = nn.LayerNorm(layout.channels, eps=1e-6)
        self.mlp = _Mlp(layout)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(self.norm1(x))
        return x + self.mlp(self.norm2(x))


class _PatchEmbedding(nn.Module):
    def __init__(self, layout: WilorLayout) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, layout.channels, layout.patch, stride=layout.patch, padding=_PADDING)

    def forward(self, pixels: Tensor) -> Tensor:
        return self.proj(pixels)


class WilorBackbone(nn.Module):
    """ViT over pose, shape, camera and patch tokens, with the checkpoint's parameter names."""

    init_hand_pose: Tensor
    init_betas: Tensor
    init_cam: Tensor

    def __init__(self, layout: WilorLayout) -> None:
        super().__init__()
        self.layout = layout
        rows, columns = layout.patch_grid
        width = layout.channels
        self.patch_embed = _PatchEmbedding(layout)
        # One more than there are patches: that of a class token, which WiLoR adds to every patch.
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + rows * columns, width))
        self.pose_emb, self.shape_emb = nn.Linear(6, width), nn.Linear(10, width)
        self.cam_emb = nn.Linear(3, width)
        self.register_buffer("init_hand_pose", torch.zeros(1, 6 * layout.joints))  # mean rotations, 6D
        self.register_buffer("init_betas", torch.zeros(1, 10))
        self.register_buffer("init_cam", torch.zeros(1, 3))
        self.blocks = nn.ModuleList(_Block(layout) for _ in range(layout.depth))
        self.last_norm = nn.LayerNorm(width, eps=1e-6)

    def forward(
        self, pixels: Float[Tensor, "view 3 height width"]
    ) -> Float[Tensor, "view channel row column"]:
        """Features of the patches (WiLoR's img_feat) of ImageNet-normalised images of any size."""
        patches = self.patch_embed(pixels)
        rows, columns = patches.shape[-2:]
        patches = (patches + self._positions(rows, columns)).flatten(2).transpose(1, 2)
        tokens = torch.cat([self._mano_tokens().expand(len(pixels), -1, -1), patches], dim=1)
        for block in self.blocks:
            tokens = block(tokens)
        features = self.last_norm(tokens)[:, -rows * columns :]
        return features.transpose(1, 2).unflatten(2, (rows, columns))

    def _mano_tokens(self) -> Float[Tensor, "1 token channel"]:
        pose = self.pose_emb(self.init_hand_pose.reshape(1, self.layout.joints, 6))
        return torch.cat(
            [pose, self.shape_emb(self.init_betas)[:, None], self.cam_emb(self.init_cam)[:, None]], dim=1
        )

    def _positions(self, rows: int, columns: int) -> Float[Tensor, "1 channel row column"]:
        grid = (
            (self.pos_embed[:, 1:] + self.pos_embed[:, :1])
            .transpose(1, 2)
            .unflatten(2, self.layout.patch_grid)
        )
        if (rows, columns) == self.layout.patch_grid:
            return grid
        stretched = functional.interpolate(
            grid.float(), size=(rows, columns), mode="bicubic", align_corners=False
        )
        return stretched.to(grid.dtype)


@dataclass(frozen=True, kw_only=True)
class WilorConfig:
    """`image_size`: pixels (the paper's is 224); `grid`: tokens along a side, 14 for one a patch."""

    checkpoint: Path
    image_size: Annotated[int, Range(8, 8192)]
    grid: Annotated[int, Range(1, 1024)]
    layout: WilorLayout = WILOR_LAYOUT


@dataclass(frozen=True, kw_only=True)
class WilorKeys:
    """What became of the tensors of a checkpoint; names as in the file."""

    used: tuple[str, ...]
    unused_backbone: tuple[str, ...]
    """Read-outs of MANO parameters: features are taken before them."""
    unused_other: tuple[str, ...]
    """Refinement network, MANO model, discriminator."""


@dataclass(frozen=True, kw_only=True, eq=False)
class WilorEncoder:
    """Patch features of the hand network on the token grid, 1280 channels."""

    network: WilorBackbone
    config: WilorConfig
    keys: WilorKeys

    @property
    def grid(self) -> int:
        return self.config.grid

    @property
    def channels(self) -> int:
        return self.config.layout.channels

    def to(self, device: torch.device | str, dtype: torch.dtype) -> "WilorEncoder":
        self.network.to(device, dtype)
        return self

    @torch.no_grad()
    def __call__(
        self, images: Float[Tensor, "batch view 3 size size"]
    ) -> Float[Tensor, "batch view token channel"]:
        size, patch = self.config.image_size, self.config.layout.patch
        pixels = resized(images.flatten(0, 1), size)
        mean, std = (torch.tensor(x).to(pixels).reshape(3, 1, 1) for x in (_MEAN, _STD))
        features = self.network(((pixels - mean) / std).to(self.network.pos_embed.dtype))
        centres = CellCentres(first=(0.5 * patch - _PADDING) / size, spacing=patch / size)
        tokens = resampled_tokens(features, centres, self.grid)
        return tokens.unflatten(0, images.shape[:2]).to(images.dtype)


def load_wilor(config: WilorConfig) -> WilorEncoder:
    """WiLoR's backbone out of its Lightning checkpoint, in float32 on the CPU; nothing in the file is run.

    ModelError when the file is missing or broken, or when the backbone in it has another layout.
    """
    tensors = load_state_dict(config.checkpoint, action=_ACTION)
    backbone = {
        name.removeprefix("backbone."): tensors[name] for name in tensors if name.startswith("backbone.")
    }
    with torch.device("meta"):
        network = WilorBackbone(config.layout)
    wanted = network.state_dict()
    unused = [name for name in backbone if name not in wanted]
    if problem := _mismatch(wanted, backbone, unused):
        expected = f"the backbone of wilor_final.ckpt ({len(wanted)} tensors under 'backbone.')"
        raise ModelError(config.checkpoint, problem, expected=expected, action=_ACTION)
    used = {name: backbone[name].to(torch.float32, copy=True) for name in wanted}
    network.load_state_dict(used, assign=True)
    keys = WilorKeys(
        used=tuple(f"backbone.{name}" for name in wanted),
        unused_backbone=tuple(f"backbone.{name}" for name in unused),
        unused_other=tuple(name for name in tensors if not name.startswith("backbone.")),
    )
    return WilorEncoder(network=network.eval().requires_grad_(False), config=config, keys=keys)


def _mismatch(wanted: dict[str, Tensor], found: dict[str, Tensor], unused: list[str]) -> str:
    """What keeps a state dict from being WiLoR's, or nothing."""
    if missing := [name for name in wanted if name not in found]:
        return f"{len(missing)} tensors of the backbone are missing, first {missing[0]}"
    for name, tensor in wanted.items():
        if tensor.shape != found[name].shape:
            return f"{name} has shape {tuple(found[name].shape)}, not {tuple(tensor.shape)}"
    if unknown := [name for name in unused if not name.startswith(_DECODER)]:
        return f"the backbone has {len(unknown)} unknown tensors, first {unknown[0]}"
    return ""
