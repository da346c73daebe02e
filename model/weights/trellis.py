"""The stage-1 networks of TRELLIS-image-large (FORMATS 4.2), as weights of the geometry branch and the VAE.

Time and sign need no conversion: TRELLIS has t = 0 at data and velocity = noise - clean.
"""

from pathlib import Path

import torch
from torch import Tensor

from model.errors import ModelError
from model.networks.embeddings import sincos_position_embedding
from model.sparse_structure.dual_branch import DualBranchConfig, DualBranchFlow
from model.sparse_structure.vae import StructureDecoder, StructureEncoder, VaeConfig
from model.tensor_files.safetensors_file import shapes_of
from model.weights.published import PublishedNetwork, prefixed, published_shapes
from model.weights.training_run import latent_normalisation
from model.weights.weight_file import GEOMETRY, VAE

__all__ = ["stage_one_networks"]


def stage_one_networks(flow: DualBranchConfig, vae: VaeConfig) -> tuple[PublishedNetwork, ...]:
    """The published networks of stage 1 for `import_networks`."""
    with torch.device("meta"):
        dual = DualBranchFlow(flow)
        encoder, decoder = StructureEncoder(vae), StructureDecoder(vae)
    geometry = flow.geometry

    def flow_tensors(path: Path, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        _check_latents(path)
        _check_position_embedding(path, tensors["pos_emb"], flow)
        return prefixed(GEOMETRY, tensors)

    def encoder_tensors(path: Path, tensors: dict[str, Tensor]) -> dict[str, Tensor]:  # noqa: ARG001
        return prefixed(f"{VAE}encoder.", tensors)

    def decoder_tensors(path: Path, tensors: dict[str, Tensor]) -> dict[str, Tensor]:  # noqa: ARG001
        return prefixed(f"{VAE}decoder.", tensors)

    return (
        PublishedNetwork(
            name="ss_flow_img_dit_L_16l8",
            shapes=published_shapes("ss_flow_img_dit_L_16l8"),
            class_names=("SparseStructureFlowModel",),
            arguments={
                "resolution": geometry.latent_resolution,
                "num_heads": geometry.heads,
                "patch_size": geometry.patch,
            },
            module=dual.geometry,
            new=tuple(f"flow.{name}" for name in shapes_of(dual) if not name.startswith("geometry.")),
            convert=flow_tensors,
        ),
        PublishedNetwork(
            name="ss_enc_conv3d_16l8",
            shapes=published_shapes("ss_enc_conv3d_16l8"),
            class_names=("SparseStructureEncoder",),
            arguments={},
            module=encoder,
            new=(),
            convert=encoder_tensors,
        ),
        PublishedNetwork(
            name="ss_dec_conv3d_16l8",
            shapes=published_shapes("ss_dec_conv3d_16l8"),
            class_names=("SparseStructureDecoder",),
            arguments={},
            module=decoder,
            new=(),
            convert=decoder_tensors,
        ),
    )


def _check_latents(path: Path) -> None:
    if latent_normalisation(path) is not None:
        raise ModelError(
            path,
            "was trained on normalised latents, by the config.json of its training",
            expected="a flow of the latents as the VAE gives them, as TRELLIS-image-large",
            action="Train it without dataset.args.normalization, or give the published flow.",
        )


def _check_position_embedding(path: Path, published: Tensor, flow: DualBranchConfig) -> None:
    geometry = flow.geometry
    ours = sincos_position_embedding(geometry.latent_resolution // geometry.patch, 3, geometry.channels)
    error = float((published.float() - ours).abs().max())
    # Sines and cosines in float16 are within 5e-4, in bfloat16 4e-3; another order or formula is off by about 1.
    if not error < 1e-2:
        raise ModelError(
            path,
            f"pos_emb differs by {error:.2g} from the sin-cos formula",
            expected="row-major tokens, TRELLIS's frequencies",
            action="Use an unmodified checkpoint.",
        )
