"""Published TRELLIS checkpoints (FORMATS 4.2) into our modules: every key is accounted for, or nothing is loaded.

Our modules carry TRELLIS's parameter names, so no renaming happens: a file fits exactly when names and shapes
are equal. Time and sign need no conversion either: TRELLIS has t = 0 at data and velocity = noise - clean.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from model.errors import ModelError
from model.sparse_structure.dual_branch import DualBranchFlow
from model.sparse_structure.vae import StructureDecoder, StructureEncoder

__all__ = [
    "WeightReport",
    "compare_weights",
    "import_structure_decoder",
    "import_structure_encoder",
    "import_structure_flow",
    "import_weights",
]


@dataclass(frozen=True, kw_only=True)
class WeightReport:
    """What became of every key of a file and of every tensor of a model.

    `used` was copied; `missing` is in the module and not in the file; `unused` is in the file and not in the
    module; `mismatched` is in both with other shapes; `new` lies outside the module that the file describes
    (the mask branch and the fusion of stage 1) and keeps its initial value.
    """

    source: Path
    used: tuple[str, ...]
    missing: tuple[str, ...]
    unused: tuple[str, ...]
    mismatched: tuple[str, ...]
    new: tuple[str, ...]

    @property
    def complete(self) -> bool:
        """Whether the file fits the module exactly."""
        return not (self.missing or self.unused or self.mismatched)

    def lines(self) -> list[str]:
        """One line per key, grouped: what `forehoi weights import` prints."""
        groups = {
            "used": self.used,
            "missing": self.missing,
            "unused": self.unused,
            "mismatched": self.mismatched,
            "new": self.new,
        }
        return [f"{group:<10} {name}" for group, names in groups.items() for name in names]


def _shapes_of_file(path: Path) -> dict[str, tuple[int, ...]]:
    """Names and shapes from the header alone; ModelError when it is no safetensors file."""
    try:
        with safe_open(str(path), framework="pt") as file:
            return {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError) as error:
        problem = "not found" if isinstance(error, FileNotFoundError) else str(error)
        raise ModelError(
            path,
            problem,
            expected="a safetensors file of TRELLIS-image-large/ckpts",
            action="Check the path.",
        ) from error


def compare_weights(path: Path, module: nn.Module) -> WeightReport:
    """What `import_weights` would do, without loading: `used` lists the tensors that would be copied."""
    found = _shapes_of_file(path)
    ours = {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}
    common = ours.keys() & found.keys()
    return WeightReport(
        source=path,
        used=tuple(name for name in ours if name in common and ours[name] == found[name]),
        missing=tuple(name for name in ours if name not in found),
        unused=tuple(sorted(found.keys() - ours.keys())),
        mismatched=tuple(
            f"{name} {found[name]} in the file, {ours[name]} in the module"
            for name in ours
            if name in common and ours[name] != found[name]
        ),
        new=(),
    )


def import_weights(path: Path, module: nn.Module) -> WeightReport:
    """Copy every tensor of the file into the module, float16 to the module's own dtype.

    ModelError, and an unchanged module, when a key is missing, unused or of another shape, or when the file's
    position embedding is not ours (then its tokens lie in another order).
    """
    report = compare_weights(path, module)
    if not report.complete:
        first = next(iter((*report.missing, *report.unused, *report.mismatched)))
        lengths = (len(report.missing), len(report.unused), len(report.mismatched))
        counts = "{} keys missing, {} unused, {} of another shape".format(*lengths)
        raise ModelError(
            path,
            f"{counts}, first {first}",
            expected=f"the {len(module.state_dict())} tensors of {type(module).__name__}",
            action="Use the `paper` config and the file made for this network, before adding LoRA.",
        )
    targets = module.state_dict()
    with safe_open(str(path), framework="pt") as file, torch.no_grad():
        _check_position_embedding(path, file.get_tensor("pos_emb") if "pos_emb" in targets else None, targets)
        for name in report.used:
            targets[name].copy_(file.get_tensor(name))
    return report


def _check_position_embedding(path: Path, published: Tensor | None, targets: dict[str, Tensor]) -> None:
    if published is None:
        return
    error = float((published.float() - targets["pos_emb"].float().cpu()).abs().max())
    # Sines and cosines in float16 are within 5e-4; another order or formula is off by about 1.
    if not error < 2e-3:
        raise ModelError(
            path,
            f"pos_emb differs by {error:.2g} from the sin-cos formula",
            expected="row-major tokens, TRELLIS's frequencies",
            action="Use an unmodified checkpoint.",
        )


def import_structure_encoder(path: Path, encoder: StructureEncoder) -> WeightReport:
    """ss_enc_conv3d_16l8_fp16.safetensors into the encoder of a `paper` VAE."""
    return import_weights(path, encoder)


def import_structure_decoder(path: Path, decoder: StructureDecoder) -> WeightReport:
    """ss_dec_conv3d_16l8_fp16.safetensors into the decoder of a `paper` VAE."""
    return import_weights(path, decoder)


def import_structure_flow(path: Path, flow: DualBranchFlow) -> WeightReport:
    """ss_flow_img_dit_L_16l8_fp16.safetensors into the geometry branch; the report lists what stays new.

    Keys of `used`, `missing` and `unused` are the file's; keys of `new` are those of `flow`.
    """
    report = import_weights(path, flow.geometry)
    new = tuple(name for name in flow.state_dict() if not name.startswith("geometry."))
    return WeightReport(
        source=report.source,
        used=report.used,
        missing=report.missing,
        unused=report.unused,
        mismatched=report.mismatched,
        new=new,
    )
