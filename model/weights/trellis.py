"""Published TRELLIS checkpoints (FORMATS 4.2) into our weight files: every key is accounted for, or nothing is written.

Our modules carry TRELLIS's parameter names, so a key only gets a prefix, and a file fits exactly when names and
shapes are equal. Time and sign need no conversion either: TRELLIS has t = 0 at data and velocity = noise - clean.
"""

import json
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path

import torch
from torch import Tensor, nn

from model.errors import ModelError
from model.networks.embeddings import sincos_position_embedding
from model.sparse_structure.dual_branch import DualBranchConfig, DualBranchFlow
from model.sparse_structure.vae import StructureDecoder, StructureEncoder, VaeConfig
from model.weights.safetensors_file import KeyComparison, compare_keys, read_header, read_tensors, shapes_of
from model.weights.weight_file import GEOMETRY, VAE, write_weight_file

__all__ = [
    "ImportReport",
    "ImportedFile",
    "PublishedFiles",
    "find_published",
    "import_published",
    "published_shapes",
]

_EXPECTED = "the stage-1 files of TRELLIS-image-large/ckpts"
_ACTION = "Download ss_flow_img_dit_L_16l8_fp16, ss_enc_conv3d_16l8_fp16 and ss_dec_conv3d_16l8_fp16 (.safetensors)."


@dataclass(frozen=True, kw_only=True)
class _Network:
    """One network of stage 1."""

    name: str  # in the manifest; published files begin with it
    class_name: str  # in the JSON beside the file
    prefix: str  # of its tensors in our files


_FLOW = _Network(name="ss_flow_img_dit_L_16l8", class_name="SparseStructureFlowModel", prefix=GEOMETRY)
_NETWORKS = (
    _FLOW,
    _Network(name="ss_enc_conv3d_16l8", class_name="SparseStructureEncoder", prefix=f"{VAE}encoder."),
    _Network(name="ss_dec_conv3d_16l8", class_name="SparseStructureDecoder", prefix=f"{VAE}decoder."),
)


def published_shapes(name: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a published network, e.g. "ss_enc_conv3d_16l8"."""
    manifest = json.loads((files("model.weights") / "data" / "trellis_ss.json").read_text("utf-8"))
    return {key: tuple(shape) for key, shape in manifest[name].items()}


@dataclass(frozen=True, kw_only=True)
class PublishedFiles:
    """What a source offers: the file of each network by its name, and files that are none of them."""

    found: dict[str, Path]
    ignored: tuple[Path, ...]


@dataclass(frozen=True, kw_only=True)
class ImportedFile:
    """What became of every key of a file. `new`: tensors beside the module, which keep their initial values."""

    network: str
    path: Path
    keys: KeyComparison
    new: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class ImportReport:
    """What was imported. `ignored` are files of the source that belong to no network of stage 1."""

    imported: tuple[ImportedFile, ...]
    absent: tuple[str, ...]  # networks that the source does not have
    ignored: tuple[Path, ...]
    key_list: Path  # JSON: every key


def find_published(source: Path) -> PublishedFiles:
    """The stage-1 files in a folder (or its `ckpts`), or one such file. ModelError when there is none, or one twice."""
    if source.is_file():
        return PublishedFiles(found={_network_of_file(source).name: source}, ignored=())
    if not source.is_dir():
        raise ModelError(source, "there is no such file or folder", expected=_EXPECTED, action=_ACTION)
    paths = sorted([*source.glob("*.safetensors"), *(source / "ckpts").glob("*.safetensors")])
    found: dict[str, Path] = {}
    ignored = []
    for path in paths:
        network = _network_by_name(path)
        if network is None:
            ignored.append(path)
        elif network.name in found:
            raise ModelError(
                source,
                f"holds {network.name} twice: {found[network.name].name} and {path.name}",
                expected="one file of each network",
                action="Keep one of them.",
            )
        else:
            found[network.name] = path
    if not found:
        problem = f"holds none of the networks of stage 1 among {len(paths)} safetensors files"
        raise ModelError(source, problem, expected=_EXPECTED, action=_ACTION)
    return PublishedFiles(found=found, ignored=tuple(ignored))


def import_published(source: Path, *, flow: DualBranchConfig, vae: VaeConfig, out: Path) -> ImportReport:
    """Write the weight file `out`, and beside it `*.keys.json` with what became of every key.

    The list is also written when a file does not fit; then ModelError, and no weight file.
    """
    published = find_published(source)
    with torch.device("meta"):
        dual = DualBranchFlow(flow)
        modules = {
            GEOMETRY: dual.geometry,
            f"{VAE}encoder.": StructureEncoder(vae),
            f"{VAE}decoder.": StructureDecoder(vae),
        }
    networks = [network for network in _NETWORKS if network.name in published.found]
    new = tuple(f"flow.{name}" for name in shapes_of(dual) if not name.startswith("geometry."))
    imported = tuple(
        _compared(
            network, published.found[network.name], modules[network.prefix], new if network is _FLOW else ()
        )
        for network in networks
    )
    key_list = _write_key_list(out.with_suffix(".keys.json"), imported)
    for network, file in zip(networks, imported):
        _require_complete(network, file, key_list)
    tensors: dict[str, Tensor] = {}
    for network, file in zip(networks, imported):
        tensors |= read_tensors(file.path, {name: network.prefix + name for name in file.keys.used})
        if network is _FLOW:
            _check_position_embedding(file.path, tensors[f"{GEOMETRY}pos_emb"], flow)
    write_weight_file(out, tensors, sources={file.network: file.path.name for file in imported})
    absent = tuple(network.name for network in _NETWORKS if network not in networks)
    return ImportReport(imported=imported, absent=absent, ignored=published.ignored, key_list=key_list)


def _network_by_name(path: Path) -> _Network | None:
    return next((network for network in _NETWORKS if path.name.startswith(network.name)), None)


def _network_of_file(path: Path) -> _Network:
    """By its name, else by the JSON beside it."""
    by_class = {network.class_name: network for network in _NETWORKS}
    network = _network_by_name(path) or by_class.get(str(_description(path).get("name")))
    if network is None:
        raise ModelError(
            path,
            "is not one of the networks of stage 1, by its name and by the JSON beside it",
            expected=f"a name that begins with {', '.join(network.name for network in _NETWORKS)}",
            action="Give the published file under its own name.",
        )
    return network


def _description(path: Path) -> dict[str, object]:
    """The JSON that TRELLIS puts beside its files: class name and arguments; empty when there is none."""
    json_path = path.with_suffix(".json")
    if not json_path.is_file():
        return {}
    try:
        content = json.loads(json_path.read_text("utf-8"))
    except ValueError as error:
        content, reason = None, str(error)
    else:
        reason = "no mapping"
    if not isinstance(content, dict):
        raise ModelError(
            json_path,
            f"cannot be read ({reason})",
            expected="the JSON of the checkpoint",
            action="Copy it again.",
        )
    return content


def _compared(network: _Network, path: Path, module: nn.Module, new: tuple[str, ...]) -> ImportedFile:
    class_name = _description(path).get("name", network.class_name)
    if class_name != network.class_name:
        raise ModelError(
            path,
            f"is a {class_name}, by the JSON beside it",
            expected=f"{network.class_name} ({network.name})",
            action="Give the published file under its own name.",
        )
    found = read_header(path, expected=_EXPECTED, action=_ACTION).shapes
    keys = compare_keys(found, shapes_of(module))
    return ImportedFile(network=network.name, path=path, keys=keys, new=new)


def _require_complete(network: _Network, file: ImportedFile, key_list: Path) -> None:
    if file.keys.complete:
        return
    found = read_header(file.path, expected=_EXPECTED, action=_ACTION).shapes
    if found == published_shapes(network.name):
        action = "The file is the published one: import it with configs/model/paper.yaml."
    else:
        action = f"Every key is in {key_list}; give the unmodified {network.name}_fp16.safetensors."
    count = len(file.keys.used) + len(file.keys.missing) + len(file.keys.mismatched)
    raise ModelError(
        file.path,
        file.keys.problem(),
        expected=f"the {count} tensors of {network.name} in this configuration",
        action=action,
    )


def _write_key_list(path: Path, imported: tuple[ImportedFile, ...]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {
        file.network: {"file": str(file.path), **asdict(file.keys), "new": file.new} for file in imported
    }
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path


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
