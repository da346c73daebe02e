"""The structured-latent networks of TRELLIS-image-large (FORMATS 4.2), as weights of stage 2.

Groups in our weight files, of which any may be absent:

    stage_two.flow.*                                 slat_flow_img_dit_L_64l8p2
    stage_two.normalisation.*                        of the latents that it was trained on
    stage_two.context.* stage_two.fusion.*           the rest of stage 2, of our own trainings
    slat_vae.encoder.* slat_vae.surface.*            slat_enc_swin8_B_64l8, slat_dec_mesh_swin8_B_64l8m256c

The decoders of gaussians and of radiance fields, slat_dec_gs_swin8_B_64l8gs32 and slat_dec_rf_swin8_B_64l8r16, have no
use here.
"""

from pathlib import Path

import torch
from torch import Tensor

from model.errors import ModelError
from model.networks.sparse.convolution import pointwise_from_spconv
from model.networks.view_fusion import ViewFusion
from model.structured_latent.flow import SlatFlow, SlatFlowConfig
from model.structured_latent.vae.decoder import SurfaceDecoder
from model.structured_latent.vae.encoder import SlatEncoder
from model.structured_latent.vae.latent import LatentNormalisation, SlatVaeConfig
from model.structured_latent.view_conditioned import ViewConditionedSlatFlow
from model.tensor_files.safetensors_file import read_header
from model.weights.json_file import read_json_object
from model.weights.published import PublishedNetwork, prefixed, published_shapes
from model.weights.training_run import latent_normalisation
from model.weights.weight_file import load_weights

__all__ = [
    "SLAT_ENCODER",
    "SLAT_FLOW",
    "STAGE_TWO",
    "SURFACE",
    "load_slat_vae",
    "load_stage_two_start",
    "slat_networks",
    "trellis_normalisation",
]

STAGE_TWO = "stage_two."
SLAT_FLOW = f"{STAGE_TWO}flow."
SLAT_ENCODER, SURFACE = "slat_vae.encoder.", "slat_vae.surface."

_WHERE = "slat weights"
_NETWORKS = {
    "flow": ("slat_flow_img_dit_L_64l8p2", ("SLatFlowModel", "ElasticSLatFlowModel")),
    "encoder": ("slat_enc_swin8_B_64l8", ("SLatEncoder", "ElasticSLatEncoder")),
    "surface": ("slat_dec_mesh_swin8_B_64l8m256c", ("SLatMeshDecoder", "ElasticSLatMeshDecoder")),
}
# `slat_normalization` of the pipeline.json of TRELLIS-image-large.
_MEAN = (
    -2.1687545776367188,
    -0.004347046371549368,
    -0.13352349400520325,
    -0.08418072760105133,
    -0.5271206498146057,
    0.7238689064979553,
    -1.1414450407028198,
    1.2039363384246826,
)
_STD = (
    2.377650737762451,
    2.386378288269043,
    2.124418020248413,
    2.1748552322387695,
    2.663944721221924,
    2.371192216873169,
    2.6217446327209473,
    2.684523105621338,
)


def trellis_normalisation() -> LatentNormalisation:
    """Of the latents that slat_flow_img_dit_L_64l8p2 was trained on: means of slat_enc_swin8_B_64l8."""
    return LatentNormalisation(torch.tensor(_MEAN), torch.tensor(_STD))


def slat_networks(flow: SlatFlowConfig, vae: SlatVaeConfig) -> tuple[PublishedNetwork, ...]:
    """The published networks of stage 2 for `import_networks`. ModelError: the flow pools otherwise than TRELLIS."""
    if flow.pool_pseudo_count != 1:
        raise ModelError(
            _WHERE,
            f"pool_pseudo_count is {flow.pool_pseudo_count}",
            expected="1: the published flow was trained with sums divided by count + 1",
            action="Set it to 1 in the configuration that imports.",
        )
    if flow.preconditioned:
        raise ModelError(
            _WHERE,
            "preconditioned is true",
            expected="false: the published flow gives the velocity itself",
            action="Set it to false in the configuration that imports.",
        )
    with torch.device("meta"):
        modules = {
            "flow": SlatFlow(flow),
            "encoder": SlatEncoder(vae),
            "surface": SurfaceDecoder(vae),
        }
        fusion = ViewFusion(flow.condition_channels)
    conversions = {
        "flow": _flow_tensors,
        "encoder": _encoder_tensors,
        "surface": _surface_tensors,
    }
    of_flow = {"resolution": flow.resolution, "num_heads": flow.heads, "patch_size": flow.patch}
    of_vae = {"resolution": vae.resolution, "num_heads": vae.heads, "window_size": vae.window}
    new = (f"{STAGE_TWO}context.*", *(f"{STAGE_TWO}fusion.{name}" for name in fusion.state_dict()))
    return tuple(
        PublishedNetwork(
            name=name,
            shapes=published_shapes(name),
            class_names=class_names,
            arguments=of_flow if part == "flow" else of_vae | {"attn_mode": "swin"},
            module=modules[part],
            new=new if part == "flow" else (),
            convert=conversions[part],
        )
        for part, (name, class_names) in _NETWORKS.items()
    )


def load_stage_two_start(path: Path, network: ViewConditionedSlatFlow) -> None:
    """Weights of stage 2 to start from, before adapters are added: flow and normalisation, or all of it.

    What the file has none of keeps its initial values. ModelError when a group does not fit.
    """
    load_weights(path, network.flow, group=SLAT_FLOW)
    load_weights(path, network.normalisation, group=f"{STAGE_TWO}normalisation.")
    rest = {f"{STAGE_TWO}context.": network.context, f"{STAGE_TWO}fusion.": network.fusion}
    shapes = read_header(path, expected="a weight file", action="Correct the path.").shapes
    if any(name.startswith(tuple(rest)) for name in shapes):
        for group, module in rest.items():
            load_weights(path, module, group=group)


def load_slat_vae(path: Path, encoder: SlatEncoder, surface: SurfaceDecoder) -> None:
    """Both halves of the SLat VAE. ModelError when one is missing from the file or does not fit."""
    load_weights(path, encoder, group=SLAT_ENCODER)
    load_weights(path, surface, group=SURFACE)


def _flow_tensors(path: Path, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    normalisation = _published_normalisation(path).state_dict()
    return prefixed(SLAT_FLOW, tensors) | prefixed(f"{STAGE_TWO}normalisation.", normalisation)


def _encoder_tensors(path: Path, tensors: dict[str, Tensor]) -> dict[str, Tensor]:  # noqa: ARG001
    return prefixed(SLAT_ENCODER, tensors)


def _surface_tensors(path: Path, tensors: dict[str, Tensor]) -> dict[str, Tensor]:  # noqa: ARG001
    converted = {
        name: pointwise_from_spconv(tensor) if name.endswith("skip_connection.conv.weight") else tensor
        for name, tensor in tensors.items()
    }
    return prefixed(SURFACE, converted)


def _published_normalisation(path: Path) -> LatentNormalisation:
    """Of the training's config.json, or the pipeline.json of the file's folder or the one above; else TRELLIS's."""
    if (of_run := latent_normalisation(path)) is not None:
        return _normalisation(path, "the normalization in its training's config.json", of_run)
    # Not resolved: in the cache of the hub, files are links to another folder.
    candidates = [folder / "pipeline.json" for folder in path.absolute().parents[:2]]
    pipeline = next((candidate for candidate in candidates if candidate.is_file()), None)
    if pipeline is None:
        return trellis_normalisation()
    arguments = read_json_object(pipeline, expected="the pipeline of TRELLIS").get("args")
    found = arguments.get("slat_normalization") if isinstance(arguments, dict) else None
    return _normalisation(pipeline, "args.slat_normalization", found)


def _normalisation(path: Path, what: str, found: object) -> LatentNormalisation:
    try:
        mean, std = (torch.tensor(found[name], dtype=torch.float32) for name in ("mean", "std"))  # type: ignore[index]
        return LatentNormalisation(mean, std)
    except (ValueError, KeyError, TypeError) as error:
        raise ModelError(
            path,
            f"{what} cannot be read ({error})",
            expected="lists mean and std, one number for each latent channel",
            action="Copy it again, or move it away for TRELLIS-image-large's own values.",
        ) from error
