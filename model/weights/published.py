"""The networks that TRELLIS publishes: their names, shapes and arguments, and the modules of ours that they fit.

Our modules carry the published parameter names, so a file fits exactly when names and shapes are equal. What these
do not say (attention heads, windows) is compared with the JSON that TRELLIS puts beside a file.
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from torch import Tensor, nn

from model.weights.json_file import read_json_object
from model.weights.stored_tensors import plain_stem
from model.weights.training_run import network_description

__all__ = [
    "PublishedNetwork",
    "Shapes",
    "description",
    "other_release",
    "prefixed",
    "published_shapes",
]

Shapes = Mapping[str, tuple[int, ...]]

_OTHER_RELEASES = (  # names of files and folders that are easily taken for those of TRELLIS-image-large
    (re.compile(r"_txt_dit_(B|L|XL)_|TRELLIS-text"), "TRELLIS-text"),
    (re.compile(r"_1_3B_|_next_dc_|img2shape|imgshape2tex|TRELLIS\.2"), "TRELLIS.2"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class PublishedNetwork:
    """One published network and the module of ours that its file fits."""

    name: str  # published files begin with it
    shapes: Shapes  # as published
    class_names: tuple[str, ...]  # in the JSON beside the file
    arguments: Mapping[str, object]  # what that JSON must say, where it says it
    module: nn.Module  # of our configuration, without weights
    new: tuple[str, ...]  # ours beside it, which keep their initial values
    convert: Callable[[Path, dict[str, Tensor]], dict[str, Tensor]]  # its tensors to those of our files

    def is_named(self, path: Path) -> bool:
        """Whether a file is called like the published one: in any precision, of any step, as a copy."""
        rest = plain_stem(path).removeprefix(self.name)
        return rest != plain_stem(path) and not rest[:1].isalnum()


def published_shapes(name: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a network of TRELLIS-image-large, e.g. "ss_enc_conv3d_16l8" or "slat_enc_swin8_B_64l8"."""
    stage = name.partition("_")[0]
    manifest = json.loads((files("model.weights") / "data" / f"trellis_{stage}.json").read_text("utf-8"))
    return {key: tuple(shape) for key, shape in manifest[name].items()}


def prefixed(group: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Published tensors under a group of our files."""
    return {group + name: tensor for name, tensor in tensors.items()}


def description(path: Path) -> dict[str, object]:
    """What the JSON beside a file or its training's config.json says of its network: class name and arguments.

    Empty when there is neither. ModelError when it cannot be read.
    """
    beside = path.with_name(f"{plain_stem(path)}.json")
    if not beside.is_file():
        return network_description(path)
    return read_json_object(beside, expected="the JSON of the checkpoint")


def other_release(name: str) -> str:
    """The release of TRELLIS that a file or folder of this name belongs to, where it is another; else empty."""
    return next((release for pattern, release in _OTHER_RELEASES if pattern.search(name)), "")
