"""Our weight files: what a training can start from, wherever it came from.

One safetensors file with the names of our own modules, of which any group may be absent:

    flow.geometry.*                                             the geometry branch
    flow.masks.* flow.fusion.* flow.context.* aggregator.*      the rest of stage 1
    vae.*                                                       the sparse-structure VAE

Its header says where the tensors came from and holds a digest of them, by which checkpoints know the file
that they stand on.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor, nn

from model.errors import ModelError
from model.sparse_structure.stage_one import StageOne
from model.tensor_files.safetensors_file import (
    Header,
    compare_keys,
    read_header,
    read_tensors,
    shapes_of,
    write_tensors,
)
from shards.settings import Range

__all__ = [
    "GEOMETRY",
    "VAE",
    "StartConfig",
    "load_start",
    "load_weights",
    "weights_sha256",
    "write_weight_file",
]

_FORMAT = "forehoi-weights-1"
_EXPECTED = "a file written by `forehoi weights import` or `forehoi weights merge`"
_ACTION = "Make it with one of them (`forehoi weights --help`), or correct the path."
GEOMETRY, VAE = "flow.geometry.", "vae."


@dataclass(frozen=True, kw_only=True)
class StartConfig:
    """Weights to start from instead of random ones."""

    weights: Path  # a file of ours
    # by which the latents were divided that they were trained on; TRELLIS: 1
    latent_scale: Annotated[float, Range(1e-6, 1e6)]

    def __post_init__(self) -> None:
        if not self.latent_scale > 0:
            raise ModelError(
                "start.latent_scale",
                f"is {self.latent_scale}",
                expected="a positive number",
                action="Use 1 for TRELLIS.",
            )


def write_weight_file(path: Path, tensors: Mapping[str, Tensor], *, sources: Mapping[str, str]) -> None:
    """Write `tensors` under our names; the file appears whole or not at all. `sources` says what came from where."""
    saved = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    metadata = {"format": _FORMAT, "sha256": _digest(saved), "sources": json.dumps(dict(sources))}
    write_tensors(path, saved, metadata)


def weights_sha256(path: Path) -> str:
    """Digest of the tensors of a file of ours, from its header."""
    return _header(path).metadata["sha256"]


def load_weights(path: Path, module: nn.Module, *, group: str) -> None:
    """Copy the tensors of `group`, e.g. "vae.", into a module, to its own dtype.

    ModelError, and an unchanged module, when one is missing, too many, of another shape or not finite.
    """
    shapes = _header(path).shapes
    found = {name.removeprefix(group): shape for name, shape in shapes.items() if name.startswith(group)}
    comparison = compare_keys(found, shapes_of(module))
    if not comparison.complete:
        raise ModelError(
            path,
            f"its {group}* do not fit this configuration: {comparison.problem()}",
            expected=f"the {len(shapes_of(module))} tensors of {type(module).__name__}",
            action="Use the configuration that the file was made with, or make it again with this one.",
        )
    tensors = read_tensors(path, {group + name: name for name in comparison.used})
    targets = module.state_dict()
    with torch.no_grad():
        for name, tensor in tensors.items():
            targets[name].copy_(tensor)


def load_start(path: Path, network: StageOne) -> None:
    """Weights of stage 1 to start from, before adapters are added: the geometry branch, or all of it.

    What the file has none of keeps its initial values.
    """
    flow = network.flow
    load_weights(path, flow.geometry, group=GEOMETRY)
    new = {
        "flow.masks.": flow.masks,
        "flow.fusion.": flow.fusion,
        "flow.context.": flow.context,
        "aggregator.": network.aggregator,
    }
    if any(name.startswith(tuple(new)) for name in _header(path).shapes):
        for group, module in new.items():
            load_weights(path, module, group=group)


def _header(path: Path) -> Header:
    header = read_header(path, expected=_EXPECTED, action=_ACTION)
    if header.metadata.get("format") != _FORMAT or "sha256" not in header.metadata:
        raise ModelError(path, "is a safetensors file of another kind", expected=_EXPECTED, action=_ACTION)
    return header


def _digest(tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)};".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
