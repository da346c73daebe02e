"""Published TRELLIS weights: names and shapes one to one, and every key accounted for."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from model.errors import ModelError
from model.recipes.config import load_config
from model.sparse_structure.dual_branch import DualBranchFlow
from model.tensor_files.safetensors_file import shapes_of
from model.weights.importing import import_networks
from model.weights.published import published_shapes
from model.weights.source import find_published
from model.weights.trellis import stage_one_networks
from tests.model.stages import stage_one
from tests.model.weights.published import (
    CLASSES,
    DECODER,
    ENCODER,
    FLOW,
    SMALL_FLOW,
    SMALL_VAE,
    modules,
    refused,
    write_published,
)

ROOT = Path(__file__).resolve().parents[3]
RESEARCH = ROOT.parent / "shared/research/trellis_parameters.json"
PAPER = stage_one(load_config("paper"))
PREFIXES = {FLOW: "flow.geometry.", ENCODER: "vae.encoder.", DECODER: "vae.decoder."}


def run(source: Path, out: Path, flow=SMALL_FLOW, vae=SMALL_VAE):
    return import_networks(source, stage_one_networks(flow, vae), out)


def fails(source: Path, out: Path, *parts: str) -> str:
    return refused(lambda: run(source, out), out, *parts)


def test_paper_config_has_the_published_names_and_shapes() -> None:
    for name, module in modules(PAPER.stage_one.network, PAPER.vae.network).items():
        assert shapes_of(module) == published_shapes(name)


def test_paper_config_has_the_published_number_of_parameters() -> None:
    counts = {
        name: sum(p.numel() for p in module.parameters())
        for name, module in modules(PAPER.stage_one.network, PAPER.vae.network).items()
    }
    assert counts[FLOW] == pytest.approx(555e6, rel=2e-3)  # FORMATS 4.1
    assert counts[FLOW] == sum(
        int(torch.tensor(shape).prod()) for name, shape in published_shapes(FLOW).items() if name != "pos_emb"
    )


@pytest.mark.skipif(not RESEARCH.exists(), reason="the research notes are not part of the repository")
def test_manifest_repeats_the_research_notes() -> None:
    research = json.loads(RESEARCH.read_text())
    for name in CLASSES:
        noted = {key: tuple(shape) for key, shape in research[name]["parameters"].items()}
        assert noted == published_shapes(name)


def test_new_parameters_are_outside_the_geometry_branch() -> None:
    with torch.device("meta"):
        flow = DualBranchFlow(PAPER.stage_one.network)
    new = {name for name in flow.state_dict() if not name.startswith("geometry.")}
    assert {name.split(".")[0] for name in new} == {"masks", "fusion", "context"}


def test_a_folder_is_imported_bit_for_bit_and_every_key_listed(tmp_path: Path) -> None:
    written = write_published(tmp_path / "TRELLIS" / "ckpts")
    save_file({"x": torch.zeros(1)}, tmp_path / "TRELLIS/ckpts/slat_flow_img_dit_L_64l8p2_fp16.safetensors")
    out = tmp_path / "weights" / "trellis.safetensors"
    report = run(tmp_path / "TRELLIS", out)
    found = load_file(out)
    assert found.keys() == {PREFIXES[name] + key for name in written for key in written[name]}
    for name, tensors in written.items():
        for key, tensor in tensors.items():
            assert torch.equal(found[PREFIXES[name] + key], tensor)
            assert found[PREFIXES[name] + key].dtype == torch.float16
    assert [path.name for path in report.ignored] == ["slat_flow_img_dit_L_64l8p2_fp16.safetensors"]
    assert not report.absent
    listed = json.loads(report.key_list.read_text())
    assert report.key_list == tmp_path / "weights" / "trellis.keys.json"
    for name, tensors in written.items():
        assert set(listed[name]["used"]) == set(tensors)
        assert listed[name]["missing"] == listed[name]["unused"] == listed[name]["mismatched"] == []
    with torch.device("meta"):
        rest = {
            f"flow.{name}" for name in DualBranchFlow(SMALL_FLOW).state_dict() if not name.startswith("geom")
        }
    assert set(listed[FLOW]["new"]) == rest


def test_single_files_by_name_or_by_the_json_beside_them(tmp_path: Path) -> None:
    write_published(tmp_path)
    report = run(tmp_path / f"{DECODER}_fp16.safetensors", tmp_path / "a.safetensors")
    assert set(report.absent) == {FLOW, ENCODER}
    for suffix in ("safetensors", "json"):
        (tmp_path / f"{ENCODER}_fp16.{suffix}").rename(tmp_path / f"mine.{suffix}")
    assert find_published(tmp_path / "mine.safetensors", stage_one_networks(SMALL_FLOW, SMALL_VAE)).found == {
        ENCODER: tmp_path / "mine.safetensors"
    }
    (tmp_path / "mine.json").unlink()
    save_file({"x": torch.zeros(1)}, tmp_path / "mine.safetensors")
    fails(tmp_path / "mine.safetensors", tmp_path / "b.safetensors", "is none of the published networks")


def test_a_key_too_few_too_many_or_of_another_shape_is_refused_and_listed(tmp_path: Path) -> None:
    tensors = write_published(tmp_path / "in")[ENCODER]
    del tensors["input_layer.bias"]
    tensors |= {"extra": torch.zeros(1), "out_layer.2.bias": torch.zeros(2)}
    save_file(tensors, tmp_path / "in" / f"{ENCODER}_fp16.safetensors")
    fails(
        tmp_path / "in",
        tmp_path / "out.safetensors",
        "1 missing (input_layer.bias), 1 unused (extra), 1 of another shape",
        "out_layer.2.bias (2,) in the file, (16,) in the module",
        "out.keys.json",
    )
    listed = json.loads((tmp_path / "out.keys.json").read_text())[ENCODER]
    assert (listed["missing"], listed["unused"]) == (["input_layer.bias"], ["extra"])


def _sparse_published_file(path: Path, name: str) -> None:
    """The published header before as many zeros as its tensors take (1.1 GB for the flow, none of it on the disk)."""
    header, offset = {}, 0
    for key, shape in published_shapes(name).items():
        size = 2 * int(torch.tensor(shape).prod())
        header[key] = {"dtype": "F16", "shape": shape, "data_offsets": [offset, offset + size]}
        offset += size
    text = json.dumps(header).encode()
    with path.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        file.truncate(8 + len(text) + offset)


def test_the_published_flow_fits_the_paper_config_and_no_other(tmp_path: Path) -> None:
    path = tmp_path / f"{FLOW}_fp16.safetensors"
    _sparse_published_file(path, FLOW)
    fails(path, tmp_path / "out.safetensors", "import it with --config paper")
    with pytest.raises(ModelError, match="pos_emb differs by 1"):  # zeros: all 489 keys fit, and are read
        run(path, tmp_path / "out.safetensors", PAPER.stage_one.network, PAPER.vae.network)
    listed = json.loads((tmp_path / "out.keys.json").read_text())[FLOW]
    assert len(listed["used"]) == 489


def test_another_order_of_tokens_is_refused(tmp_path: Path) -> None:
    tensors = write_published(tmp_path)[FLOW]
    tensors["pos_emb"] = tensors["pos_emb"].flip(0)
    save_file(tensors, tmp_path / f"{FLOW}_fp16.safetensors")
    fails(tmp_path, tmp_path / "out.safetensors", "pos_emb differs")


def test_another_networks_file_is_refused(tmp_path: Path) -> None:
    write_published(tmp_path)
    path = tmp_path / f"{FLOW}_fp16.safetensors"
    path.with_suffix(".json").write_text('{"name": "SLatFlowModel", "args": {}}')
    fails(tmp_path, tmp_path / "out.safetensors", "is a SLatFlowModel")
    path.with_suffix(".json").write_text("{")
    fails(tmp_path, tmp_path / "out.safetensors", "cannot be read")
    path.with_suffix(".json").unlink()
    path.write_bytes((tmp_path / f"{DECODER}_fp16.safetensors").read_bytes())
    fails(tmp_path, tmp_path / "out.safetensors", "missing (", "unmodified ss_flow_img_dit_L_16l8_fp16")


def test_broken_files_are_one_line(tmp_path: Path) -> None:
    tensors = write_published(tmp_path)[ENCODER]
    path, out = tmp_path / f"{ENCODER}_fp16.safetensors", tmp_path / "out.safetensors"
    whole = path.read_bytes()
    for torn in (b"", whole[:5], whole[:100], whole[:-1], b"\xff" * 100, whole + b"x"):
        path.write_bytes(torn)
        fails(tmp_path, out, "is no complete safetensors file")
    path.write_bytes(whole.replace(b'"F16"', b'"F61"', 1))
    fails(tmp_path, out, "is no complete safetensors file")
    save_file(tensors | {"input_layer.bias": torch.zeros(4, dtype=torch.int8)}, path)
    fails(tmp_path, out, "stores input_layer.bias as I8 (1 such tensors)", "F16")
    save_file(tensors | {"input_layer.bias": torch.full((4,), torch.nan)}, path)
    fails(tmp_path, out, "input_layer.bias holds NaN")


def test_sources_without_networks(tmp_path: Path) -> None:
    out = tmp_path / "out.safetensors"
    fails(tmp_path / "none", out, "there is no such file or folder")
    fails(tmp_path, out, "none of the published networks", "Download")
    write_published(tmp_path)
    (tmp_path / f"{FLOW}_bf16.safetensors").write_bytes(b"")
    fails(tmp_path, out, "twice")
