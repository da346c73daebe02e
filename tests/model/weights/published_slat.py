"""Structured-latent files like those that TRELLIS publishes, with random values, for networks of any size."""

import json
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from model.structured_latent.flow import SlatFlow, SlatFlowConfig
from model.structured_latent.vae.decoder import SurfaceDecoder
from model.structured_latent.vae.encoder import SlatEncoder
from model.structured_latent.vae.latent import SlatVaeConfig

FLOW, ENCODER = "slat_flow_img_dit_L_64l8p2", "slat_enc_swin8_B_64l8"
DECODER = "slat_dec_mesh_swin8_B_64l8m256c"
CLASSES = {
    FLOW: "SLatFlowModel",
    ENCODER: "SLatEncoder",
    DECODER: "SLatMeshDecoder",
}


def modules(flow: SlatFlowConfig, vae: SlatVaeConfig) -> dict[str, nn.Module]:
    """The networks of stage 2, by their published names."""
    return {
        FLOW: SlatFlow(flow),
        ENCODER: SlatEncoder(vae),
        DECODER: SurfaceDecoder(vae),
    }


def write_published(
    folder: Path, flow: SlatFlowConfig, vae: SlatVaeConfig, *, std: float = 0.2
) -> dict[str, dict[str, Tensor]]:
    """NAME_fp16.safetensors and NAME_fp16.json for each network; their tensors."""
    folder.mkdir(parents=True, exist_ok=True)
    generator, written = torch.Generator().manual_seed(0), {}
    for name, module in modules(flow, vae).items():
        tensors = {
            key: (std * torch.randn(tensor.shape, generator=generator)).half()
            for key, tensor in module.state_dict().items()
        }
        save_file(tensors, folder / f"{name}_fp16.safetensors")
        (folder / f"{name}_fp16.json").write_text(json.dumps({"name": CLASSES[name], "args": {}}))
        written[name] = tensors
    return written
