"""Published TRELLIS weights: names and shapes one to one, and every key accounted for."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from model.errors import ModelError
from model.networks.lora import LoraSettings, add_lora
from model.sparse_structure.dual_branch import DualBranchConfig, DualBranchFlow
from model.sparse_structure.geometry_branch import GeometryBranchConfig
from model.sparse_structure.mask_branch import MaskBranchConfig
from model.sparse_structure.vae import StructureDecoder, StructureEncoder, VaeConfig
from model.weights.trellis import (
    compare_weights,
    import_structure_decoder,
    import_structure_encoder,
    import_structure_flow,
)

ROOT = Path(__file__).resolve().parents[3]
MANIFEST = json.loads((ROOT / "model/weights/trellis_ss.json").read_text())
RESEARCH = ROOT.parent / "shared/research/trellis_parameters.json"

PAPER_VAE = VaeConfig(channels=(32, 128, 512), latent_channels=8, residual_blocks=(2, 2, 2), middle_blocks=2)
SMALL_VAE = VaeConfig(channels=(4, 8), latent_channels=8, residual_blocks=(1, 1), middle_blocks=1)


def _flow_config(
    channels: int, blocks: int, mask_blocks: int, heads: int, resolution: int, grid: int
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
            latent_rms=None,
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


PAPER_FLOW = _flow_config(1024, 24, 12, 16, 16, 37)
SMALL_FLOW = _flow_config(16, 2, 1, 2, 2, 2)


def _shapes(module: nn.Module) -> dict[str, list[int]]:
    return {name: list(tensor.shape) for name, tensor in module.state_dict().items()}


def _published(module: nn.Module, seed: int) -> dict[str, torch.Tensor]:
    """A float16 checkpoint of the module's names and shapes with random values (the position embedding kept)."""
    generator = torch.Generator().manual_seed(seed)
    return {
        name: (tensor if name == "pos_emb" else torch.randn(tensor.shape, generator=generator)).half()
        for name, tensor in module.state_dict().items()
    }


def test_paper_config_has_the_published_names_and_shapes() -> None:
    with torch.device("meta"):
        modules = {
            "ss_enc_conv3d_16l8": StructureEncoder(PAPER_VAE),
            "ss_dec_conv3d_16l8": StructureDecoder(PAPER_VAE),
            "ss_flow_img_dit_L_16l8": DualBranchFlow(PAPER_FLOW).geometry,
        }
    assert {name: _shapes(module) for name, module in modules.items()} == MANIFEST


@pytest.mark.skipif(not RESEARCH.exists(), reason="the research notes are not part of the repository")
def test_manifest_repeats_the_research_notes() -> None:
    research = json.loads(RESEARCH.read_text())
    assert {name: research[name]["parameters"] for name in MANIFEST} == MANIFEST


def test_new_parameters_are_outside_the_geometry_branch() -> None:
    with torch.device("meta"):
        flow = DualBranchFlow(PAPER_FLOW)
    new = {name for name in flow.state_dict() if not name.startswith("geometry.")}
    assert {name.split(".")[0] for name in new} == {"masks", "fusion", "context"}
    assert {name.split(".")[1] for name in new if name.startswith("masks.")} == {
        "t_embedder",
        "feature_layer",
        "input_layer",
        "blocks",
        "out_layer",
    }


def test_vae_weights_are_copied(tmp_path: Path) -> None:
    encoder, decoder = StructureEncoder(SMALL_VAE), StructureDecoder(SMALL_VAE)
    for module, load in ((encoder, import_structure_encoder), (decoder, import_structure_decoder)):
        published = _published(module, seed=1)
        path = tmp_path / f"{type(module).__name__}.safetensors"
        save_file(published, path)
        report = load(path, module)
        assert report.complete
        assert set(report.used) == set(published)
        for name, tensor in module.state_dict().items():
            assert tensor.dtype == torch.float32
            assert torch.equal(tensor, published[name].float())


def test_flow_weights_are_copied_and_new_ones_listed(tmp_path: Path) -> None:
    flow = DualBranchFlow(SMALL_FLOW)
    new_before = {
        name: tensor.clone() for name, tensor in flow.state_dict().items() if not name.startswith("geometry.")
    }
    published, path = _published(flow.geometry, seed=2), tmp_path / "flow.safetensors"
    save_file(published, path)
    report = import_structure_flow(path, flow)
    assert set(report.used) == set(published)
    assert set(report.new) == set(new_before)
    for name, tensor in flow.state_dict().items():
        expected = (
            published[name.removeprefix("geometry.")].float()
            if name.startswith("geometry.")
            else new_before[name]
        )
        assert torch.equal(tensor, expected)
    assert len(report.lines()) == len(flow.state_dict())
    assert "used       blocks.0.self_attn.to_qkv.weight" in report.lines()


def test_header_of_the_full_flow_is_read_without_its_tensors(tmp_path: Path) -> None:
    """All 489 keys of the published flow against the paper config; a sparse file stands in for 1.1 GB."""
    header, offset = {}, 0
    for name, shape in MANIFEST["ss_flow_img_dit_L_16l8"].items():
        size = 2 * int(torch.tensor(shape).prod())
        header[name] = {"dtype": "F16", "shape": shape, "data_offsets": [offset, offset + size]}
        offset += size
    text = json.dumps(header).encode()
    path = tmp_path / "ss_flow_img_dit_L_16l8_fp16.safetensors"
    with path.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        file.truncate(8 + len(text) + offset)
    with torch.device("meta"):
        report = compare_weights(path, DualBranchFlow(PAPER_FLOW).geometry)
    assert report.complete
    assert len(report.used) == 489


def test_a_key_too_few_too_many_or_of_another_shape_is_refused(tmp_path: Path) -> None:
    encoder = StructureEncoder(SMALL_VAE)
    before = {name: tensor.clone() for name, tensor in encoder.state_dict().items()}
    published = _published(encoder, seed=3)
    del published["input_layer.bias"]
    published["extra"] = torch.zeros(1)
    published["out_layer.2.bias"] = torch.zeros(2)
    path = tmp_path / "encoder.safetensors"
    save_file(published, path)
    report = compare_weights(path, encoder)
    assert (report.missing, report.unused) == (("input_layer.bias",), ("extra",))
    assert report.mismatched == ("out_layer.2.bias (2,) in the file, (16,) in the module",)
    with pytest.raises(ModelError, match="1 keys missing, 1 unused, 1 of another shape") as caught:
        import_structure_encoder(path, encoder)
    assert "\n" not in str(caught.value)
    assert all(torch.equal(tensor, before[name]) for name, tensor in encoder.state_dict().items())


def test_another_order_of_tokens_is_refused(tmp_path: Path) -> None:
    flow, path = DualBranchFlow(SMALL_FLOW), tmp_path / "flow.safetensors"
    published = _published(flow.geometry, seed=4)
    published["pos_emb"] = published["pos_emb"].flip(0)
    save_file(published, path)
    with pytest.raises(ModelError, match="pos_emb differs"):
        import_structure_flow(path, flow)


def test_weights_go_in_before_lora(tmp_path: Path) -> None:
    flow, path = DualBranchFlow(SMALL_FLOW), tmp_path / "flow.safetensors"
    save_file(_published(flow.geometry, seed=5), path)
    add_lora(flow.geometry, LoraSettings(rank=2, alpha=4, dropout=0.0))
    with pytest.raises(ModelError, match="before adding LoRA"):
        import_structure_flow(path, flow)


def test_files_that_are_not_checkpoints(tmp_path: Path) -> None:
    encoder = StructureEncoder(SMALL_VAE)
    with pytest.raises(ModelError, match="not found"):
        import_structure_encoder(tmp_path / "none.safetensors", encoder)
    torn = tmp_path / "torn.safetensors"
    torn.write_bytes(b"0123456789")
    with pytest.raises(ModelError, match="safetensors"):
        import_structure_encoder(torn, encoder)
