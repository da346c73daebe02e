"""Files like those that TRELLIS publishes, with random values, for networks of any size."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from model.errors import ModelError
from model.networks.embeddings import sincos_position_embedding
from model.sparse_structure.dual_branch import DualBranchConfig, DualBranchFlow
from model.sparse_structure.geometry_branch import GeometryBranchConfig
from model.sparse_structure.mask_branch import MaskBranchConfig
from model.sparse_structure.vae import StructureDecoder, StructureEncoder, VaeConfig

FLOW, ENCODER, DECODER = "ss_flow_img_dit_L_16l8", "ss_enc_conv3d_16l8", "ss_dec_conv3d_16l8"
CLASSES = {
    FLOW: "SparseStructureFlowModel",
    ENCODER: "SparseStructureEncoder",
    DECODER: "SparseStructureDecoder",
}


def flow_config(
    *, channels: int, blocks: int, mask_blocks: int, heads: int, resolution: int, grid: int
) -> DualBranchConfig:
    return DualBranchConfig(
        geometry=GeometryBranchConfig(
            latent_resolution=resolution,
            latent_channels=8,
            patch=1,
            channels=channels,
            condition_channels=channels,
            blocks=blocks,
            heads=heads,
            mlp_ratio=4,
            preconditioned=False,
        ),
        masks=MaskBranchConfig(
            feature_channels=channels,
            grid=grid,
            patch=4,
            channels=channels,
            blocks=mask_blocks,
            heads=heads,
            mlp_ratio=4,
        ),
        checkpoint_blocks=False,
    )


SMALL_FLOW = flow_config(channels=16, blocks=2, mask_blocks=1, heads=2, resolution=2, grid=2)
SMALL_VAE = VaeConfig(patch=1, channels=(4, 8), latent_channels=8, residual_blocks=(1, 1), middle_blocks=1)


def modules(flow: DualBranchConfig, vae: VaeConfig) -> dict[str, nn.Module]:
    """The networks of stage 1 without weights, by their published names."""
    with torch.device("meta"):
        return {
            FLOW: DualBranchFlow(flow).geometry,
            ENCODER: StructureEncoder(vae),
            DECODER: StructureDecoder(vae),
        }


def published_tensors(module: nn.Module, seed: int, *, std: float = 1.0) -> dict[str, torch.Tensor]:
    """Float16 tensors of the module's names and shapes: random, but for the position embedding."""
    generator = torch.Generator().manual_seed(seed)
    tensors = {
        name: (std * torch.randn(tensor.shape, generator=generator)).half()
        for name, tensor in module.state_dict().items()
    }
    if "pos_emb" in tensors:
        tokens, channels = tensors["pos_emb"].shape
        tensors["pos_emb"] = sincos_position_embedding(round(tokens ** (1 / 3)), 3, channels).half()
    return tensors


def write_published(
    folder: Path, flow: DualBranchConfig = SMALL_FLOW, vae: VaeConfig = SMALL_VAE, *, std: float = 1.0
) -> dict[str, dict[str, torch.Tensor]]:
    """NAME_fp16.safetensors and NAME_fp16.json for each network; their tensors."""
    folder.mkdir(parents=True, exist_ok=True)
    written = {}
    for seed, (name, module) in enumerate(modules(flow, vae).items()):
        written[name] = published_tensors(module, seed, std=std)
        save_file(written[name], folder / f"{name}_fp16.safetensors")
        (folder / f"{name}_fp16.json").write_text(json.dumps({"name": CLASSES[name], "args": {}}))
    return written


def refused(make: Callable[[], object], out: Path, *parts: str) -> str:
    """The one line that says all of `parts`; no weight file."""
    with pytest.raises(ModelError) as caught:
        make()
    text = str(caught.value)
    assert "\n" not in text
    assert all(part in text for part in parts), text
    assert not out.exists()
    return text
