"""Published structured-latent networks: names and shapes one to one, every key accounted for, same function."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from model.encoders.aggregator import AggregatorConfig, FeatureAggregator
from model.errors import ModelError
from model.networks.lora import add_lora
from model.recipes.config import load_config
from model.recipes.stage_two_config import StageTwoTrainingConfig
from model.structured_latent.flow import SlatFlow
from model.structured_latent.vae.decoder import SurfaceDecoder
from model.structured_latent.vae.latent import LatentNormalisation, SlatVaeConfig
from model.structured_latent.view_conditioned import ViewConditionedSlatFlow
from model.tensor_files.safetensors_file import shapes_of
from model.weights.importing import ImportReport, import_networks
from model.weights.published import published_shapes
from model.weights.slat import (
    SLAT_ENCODER,
    SLAT_FLOW,
    SURFACE,
    load_stage_two_start,
    slat_networks,
    trellis_normalisation,
)
from model.weights.source import find_published
from model.weights.weight_file import load_weights
from tests.model.networks.adapters import trainable_parameters
from tests.model.networks.sparse.dense import from_dense
from tests.model.stages import stage_two
from tests.model.structured_latent.small_slat import PAPER_FLOW
from tests.model.weights import published_slat
from tests.model.weights.published import refused
from tests.model.weights.published_slat import DECODER, ENCODER, FLOW, modules

ROOT = Path(__file__).resolve().parents[3]
RESEARCH = ROOT.parent / "shared/research/trellis_parameters.json"
PREFIXES = {FLOW: SLAT_FLOW, ENCODER: SLAT_ENCODER, DECODER: SURFACE}
SMALL_FLOW = replace(
    PAPER_FLOW, resolution=8, channels=16, condition_channels=12, blocks=2, heads=2, io_channels=(8,)
)
SMALL_VAE = SlatVaeConfig(
    feature_channels=10,
    channels=16,
    latent_channels=8,
    blocks=2,
    heads=2,
    mlp_ratio=4,
    window=4,
    upsample=(8, 4),
    resolution=8,
)


@pytest.fixture(scope="module")
def paper() -> StageTwoTrainingConfig:
    """configs/model/paper_slat.yaml."""
    return stage_two(load_config("paper_slat"))


def write_published(folder: Path) -> dict[str, dict[str, Tensor]]:
    return published_slat.write_published(folder, SMALL_FLOW, SMALL_VAE)


def run(source: Path, out: Path) -> ImportReport:
    return import_networks(source, slat_networks(SMALL_FLOW, SMALL_VAE), out)


def fails(source: Path, out: Path, *parts: str) -> None:
    refused(lambda: run(source, out), out, *parts)


def test_the_paper_configuration_has_the_published_names_and_shapes(paper: StageTwoTrainingConfig) -> None:
    flow, vae = paper.slat_flow.network, paper.slat_vae.network
    assert flow == PAPER_FLOW
    with torch.device("meta"):
        networks = modules(flow, vae)
    for name, module in networks.items():
        assert shapes_of(module) == published_shapes(name)
    for network in slat_networks(flow, vae):
        assert shapes_of(network.module) == network.shapes


def test_adapters_of_the_paper_configuration_are_on_every_attention_projection(
    paper: StageTwoTrainingConfig,
) -> None:
    assert paper.slat_flow.lora is not None
    with torch.device("meta"):
        flow = SlatFlow(paper.slat_flow.network)
        add_lora(flow, paper.slat_flow.lora)
    adapted = {name.rpartition(".lora_")[0] for name in trainable_parameters(flow)}
    assert adapted == {
        f"blocks.{block}.{layer}"
        for block in range(24)
        for layer in ("self_attn.to_qkv", "self_attn.to_out", "cross_attn.to_q", "cross_attn.to_kv")
    } | {f"blocks.{block}.cross_attn.to_out" for block in range(24)}
    ranks = {shape[0] for name, shape in trainable_parameters(flow).items() if ".lora_A." in name}
    assert ranks == {64}


@pytest.mark.skipif(not RESEARCH.exists(), reason="the research notes are not part of the repository")
def test_manifest_and_sizes_repeat_the_research_notes(paper: StageTwoTrainingConfig) -> None:
    research = json.loads(RESEARCH.read_text())
    for network in slat_networks(paper.slat_flow.network, paper.slat_vae.network):
        noted = research[network.name]
        assert {key: tuple(shape) for key, shape in noted["parameters"].items()} == network.shapes
        assert {name: noted["args"][name] for name in network.arguments} == network.arguments


def test_a_folder_is_imported_and_every_key_listed(tmp_path: Path) -> None:
    written = write_published(tmp_path / "TRELLIS" / "ckpts")
    others = ["slat_dec_gs_swin8_B_64l8gs32_fp16.safetensors", "slat_dec_rf_swin8_B_64l8r16_fp16.safetensors"]
    for name in others:
        save_file({"x": torch.zeros(1)}, tmp_path / "TRELLIS/ckpts" / name)
    report = run(tmp_path / "TRELLIS", tmp_path / "out.safetensors")
    found = load_file(tmp_path / "out.safetensors")
    of_files = {PREFIXES[name] + key for name in written for key in written[name]}
    assert found.keys() - of_files == {"stage_two.normalisation.mean", "stage_two.normalisation.std"}
    for name, tensors in written.items():
        for key, tensor in tensors.items():
            if not key.endswith("skip_connection.conv.weight"):
                assert torch.equal(found[PREFIXES[name] + key], tensor)
    assert [path.name for path in report.ignored] == others
    assert not report.absent
    listed = json.loads(report.key_list.read_text())
    for name, tensors in written.items():
        assert set(listed[name]["used"]) == set(tensors)
        assert listed[name]["missing"] == listed[name]["unused"] == listed[name]["mismatched"] == []
    assert listed[FLOW]["new"][0] == "stage_two.context.*"


def test_pointwise_kernels_are_those_that_spconv_multiplied_by(tmp_path: Path) -> None:
    """spconv 2.3 computes x @ weight.view(in, out) for a kernel of one cell, whatever the layout says."""
    written = write_published(tmp_path)[DECODER]
    run(tmp_path, tmp_path / "out.safetensors")
    decoder = SurfaceDecoder(SMALL_VAE)
    load_weights(tmp_path / "out.safetensors", decoder, group=SURFACE)
    for level, (wide, narrow) in enumerate([(16, 8), (8, 4)]):
        occupancy = torch.rand(1, 4, 4, 4, generator=torch.Generator().manual_seed(0)) < 0.4
        x = from_dense(torch.randn(1, wide, 4, 4, 4), occupancy)
        weight = written[f"upsample.{level}.skip_connection.conv.weight"].float()
        bias = written[f"upsample.{level}.skip_connection.conv.bias"].float()
        expected = x.features @ weight.view(wide, narrow) + bias
        skip = decoder.upsample[level].skip_connection
        assert isinstance(skip, nn.Module)
        torch.testing.assert_close(skip(x).features, expected)
        name = f"{SURFACE}upsample.{level}.skip_connection.conv.weight"
        assert not torch.equal(weight, load_file(tmp_path / "out.safetensors")[name])


def _stage_two() -> ViewConditionedSlatFlow:
    aggregator = AggregatorConfig(
        image_channels=12, image_grid=2, hand_channels=6, hand_grid=2, hand_width=4, hidden=8, channels=8
    )
    return ViewConditionedSlatFlow(
        FeatureAggregator(aggregator), SlatFlow(SMALL_FLOW), LatentNormalisation.identity(8)
    )


def test_stage_two_starts_from_the_published_flow_and_its_normalisation(tmp_path: Path) -> None:
    written = write_published(tmp_path / "ckpts")[FLOW]
    run(tmp_path, tmp_path / "out.safetensors")
    network = _stage_two()
    others = {n: t.clone() for n, t in network.state_dict().items() if n.startswith(("context.", "fusion."))}
    load_stage_two_start(tmp_path / "out.safetensors", network)
    state = network.state_dict()
    for key, tensor in written.items():
        assert torch.equal(state[f"flow.{key}"], tensor.float())
    assert torch.equal(network.normalisation.std, trellis_normalisation().std)
    assert all(torch.equal(state[name], tensor) for name, tensor in others.items())


def test_the_normalisation_of_the_folder_counts(tmp_path: Path) -> None:
    write_published(tmp_path / "ckpts")
    values = {"mean": list(range(8)), "std": [2.0] * 8}
    (tmp_path / "pipeline.json").write_text(json.dumps({"args": {"slat_normalization": values}}))
    run(tmp_path, tmp_path / "out.safetensors")
    assert load_file(tmp_path / "out.safetensors")["stage_two.normalisation.mean"].tolist() == values["mean"]
    (tmp_path / "out.safetensors").unlink()
    (tmp_path / "pipeline.json").write_text("{")
    fails(tmp_path, tmp_path / "out.safetensors", "pipeline.json: cannot be read")
    for broken in ("{}", '{"args": 3}', '{"args": {"slat_normalization": {"mean": ["a"], "std": [1]}}}'):
        (tmp_path / "pipeline.json").write_text(broken)
        fails(tmp_path, tmp_path / "out.safetensors", "pipeline.json", "slat_normalization cannot be read")


def test_a_key_too_few_too_many_or_of_another_shape_is_refused_and_listed(tmp_path: Path) -> None:
    tensors = write_published(tmp_path)[DECODER]
    del tensors["input_layer.bias"]
    tensors |= {"extra": torch.zeros(1), "out_layer.bias": torch.zeros(53)}
    save_file(tensors, tmp_path / f"{DECODER}_fp16.safetensors")
    fails(
        tmp_path,
        tmp_path / "out.safetensors",
        "1 missing (input_layer.bias), 1 unused (extra), 1 of another shape",
        "out_layer.bias (53,) in the file, (101,) in the module",
        "out.keys.json",
    )
    listed = json.loads((tmp_path / "out.keys.json").read_text())[DECODER]
    assert (listed["missing"], listed["unused"]) == (["input_layer.bias"], ["extra"])


def test_what_shapes_do_not_say_is_compared_with_the_json(tmp_path: Path) -> None:
    write_published(tmp_path)
    description = tmp_path / f"{ENCODER}_fp16.json"
    for args, part in [
        ({"window_size": 8}, "window_size 8"),
        ({"num_heads": 4}, "num_heads 4"),
        ({"attn_mode": "full"}, "attn_mode full"),
    ]:
        description.write_text(json.dumps({"name": "SLatEncoder", "args": args}))
        fails(tmp_path, tmp_path / "out.safetensors", part, "by the JSON beside it")
    args = {"window_size": 4, "num_heads": 2, "attn_mode": "swin", "use_fp16": True}
    description.write_text(json.dumps({"name": "ElasticSLatEncoder", "args": args}))
    run(tmp_path, tmp_path / "out.safetensors")


def test_single_files_by_name_or_by_the_json_beside_them(tmp_path: Path) -> None:
    write_published(tmp_path)
    report = run(tmp_path / f"{DECODER}_fp16.safetensors", tmp_path / "a.safetensors")
    assert set(report.absent) == {FLOW, ENCODER}
    for suffix in ("safetensors", "json"):
        (tmp_path / f"{ENCODER}_fp16.{suffix}").rename(tmp_path / f"mine.{suffix}")
    networks = slat_networks(SMALL_FLOW, SMALL_VAE)
    found = find_published(tmp_path / "mine.safetensors", networks).found
    assert found == {ENCODER: tmp_path / "mine.safetensors"}
    (tmp_path / "mine.json").unlink()
    save_file({"x": torch.zeros(1)}, tmp_path / "mine.safetensors")
    fails(
        tmp_path / "mine.safetensors",
        tmp_path / "b.safetensors",
        "is none of the published networks",
        ENCODER,
    )


def test_other_files_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "out.safetensors"
    fails(tmp_path / "none", out, "there is no such file or folder")
    fails(
        tmp_path,
        out,
        "holds none of the published networks among 0",
        "Download from microsoft/TRELLIS-image-large/ckpts",
    )
    write_published(tmp_path)
    (tmp_path / f"{FLOW}_fp16.json").write_text('{"name": "SparseStructureFlowModel", "args": {}}')
    fails(tmp_path, out, "is a SparseStructureFlowModel", "expected SLatFlowModel")
    (tmp_path / f"{FLOW}_bf16.safetensors").write_bytes(b"")
    fails(tmp_path, out, "holds slat_flow_img_dit_L_64l8p2 twice")


def test_a_flow_that_pools_otherwise_cannot_take_the_published_weights() -> None:
    with pytest.raises(ModelError, match="pool_pseudo_count is 0"):
        slat_networks(replace(SMALL_FLOW, pool_pseudo_count=0), SMALL_VAE)


def test_a_preconditioned_flow_cannot_take_the_published_weights() -> None:
    with pytest.raises(ModelError, match="preconditioned is true"):
        slat_networks(replace(SMALL_FLOW, preconditioned=True), SMALL_VAE)
