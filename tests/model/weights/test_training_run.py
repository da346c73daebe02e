"""Output folders of TRELLIS's own trainer: which checkpoint is which network, and what its config.json says."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from model.errors import ModelError
from model.weights.importing import ImportReport, import_networks
from model.weights.slat import slat_networks
from model.weights.training_run import run_checkpoint
from model.weights.trellis import stage_one_networks
from tests.model.weights import published_slat
from tests.model.weights.published import (
    DECODER,
    ENCODER,
    FLOW,
    SMALL_FLOW,
    SMALL_VAE,
    modules,
    published_tensors,
    refused,
)
from tests.model.weights.test_slat import SMALL_FLOW as SMALL_SLAT_FLOW
from tests.model.weights.test_slat import SMALL_VAE as SMALL_SLAT_VAE

NETWORKS = stage_one_networks(SMALL_FLOW, SMALL_VAE)
STATE = {"optimizer": {"state": {}}, "step": 1000, "data_sampler": {"idx": 3}}


def trained(name: str) -> dict[str, torch.Tensor]:
    """Float32, as the trainer keeps its master weights."""
    return {
        key: t.float() for key, t in published_tensors(modules(SMALL_FLOW, SMALL_VAE)[name], seed=0).items()
    }


def write_run(folder: Path, config: object, **checkpoints: object) -> Path:
    (folder / "ckpts").mkdir(parents=True)
    if config is not None:
        (folder / "config.json").write_text(json.dumps(config))
    for name, content in checkpoints.items():
        torch.save(content, folder / "ckpts" / f"{name.replace('EMA', 'ema0.9999')}.pt")
    return folder


def run(source: Path, out: Path) -> ImportReport:
    return import_networks(source, NETWORKS, out)


def fails(source: Path, *parts: str) -> None:
    out = source.parent / "out.safetensors"
    refused(lambda: run(source, out), out, *parts)


def test_names_of_checkpoints() -> None:
    plain, mean = (
        run_checkpoint(Path("denoiser_step0100000.pt")),
        run_checkpoint(Path("a/decoder_ema0.9999_step0000007.pt")),
    )
    assert plain is not None
    assert (plain.network, plain.ema_rate, plain.step, plain.is_state) == ("denoiser", "", 100_000, False)
    assert mean is not None
    assert (mean.network, mean.ema_rate, mean.step) == ("decoder", "0.9999", 7)
    state = run_checkpoint(Path("misc_step0000007.pt"))
    assert state is not None
    assert state.is_state
    for name in ("denoiser.pt", "ss_flow_img_dit_L_16l8_fp16.pt", "step7.pt"):
        assert run_checkpoint(Path(name)) is None


@pytest.mark.parametrize("config", [{"models": {"denoiser": {"name": "SparseStructureFlowModel"}}}, {}, None])
def test_a_run_with_one_checkpoint_is_imported(tmp_path: Path, config: object) -> None:
    tensors = trained(FLOW)
    folder = write_run(tmp_path / "run", config, denoiser_EMA_step0001000=tensors, misc_step0001000=STATE)
    for source in (folder, folder / "ckpts", folder / "ckpts" / "denoiser_ema0.9999_step0001000.pt"):
        report = run(source, tmp_path / "out.safetensors")
        stored = load_file(tmp_path / "out.safetensors")
        assert stored.keys() == {f"flow.geometry.{name}" for name in tensors}
        assert all(torch.equal(stored[f"flow.geometry.{name}"], tensor) for name, tensor in tensors.items())
        assert any("no config.json of its training" in note for note in report.notes) == (not config)
        (tmp_path / "out.safetensors").unlink()


def test_both_halves_of_a_vae_are_imported(tmp_path: Path) -> None:
    config = {
        "models": {
            "encoder": {"name": "SparseStructureEncoder"},
            "decoder": {"name": "SparseStructureDecoder"},
        }
    }
    folder = write_run(
        tmp_path / "run", config, encoder_step0000010=trained(ENCODER), decoder_step0000010=trained(DECODER)
    )
    report = run(folder, tmp_path / "out.safetensors")
    assert {file.network for file in report.imported} == {ENCODER, DECODER}
    assert report.absent == (FLOW,)


def test_several_checkpoints_are_asked_about_and_the_last_average_proposed(tmp_path: Path) -> None:
    names = [
        "denoiser_step0001000",
        "denoiser_EMA_step0001000",
        "denoiser_step0002000",
        "denoiser_EMA_step0002000",
    ]
    folder = write_run(tmp_path / "run", {}, **{name: {} for name in names})
    best = folder / "ckpts" / "denoiser_ema0.9999_step0002000.pt"
    fails(
        folder,
        "is the output of a training of TRELLIS with 4 checkpoints",
        f"Give one of them as a file, for example {best}.",
    )
    fails(best, "holds an empty dict")
    only_state = write_run(tmp_path / "state", {}, misc_step0001000=STATE)
    fails(only_state, "is the output of a training of TRELLIS without weights")
    fails(only_state / "ckpts" / "misc_step0001000.pt", "optimiser's state of a training, no weights")


def test_published_files_come_before_checkpoints(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", {}, denoiser_step0001000=trained(FLOW))
    torch.save(trained(FLOW), folder / "ckpts" / f"{FLOW}_fp32.pt")
    report = run(folder, tmp_path / "out.safetensors")
    assert [file.path.name for file in report.imported] == [f"{FLOW}_fp32.pt"]
    assert [path.name for path in report.ignored] == ["denoiser_step0001000.pt"]


def test_what_the_config_says_about_the_network_is_compared(tmp_path: Path) -> None:
    for number, (model, part) in enumerate(
        [
            ({"name": "SparseStructureFlowModel", "args": {"num_heads": 16}}, "has num_heads 16"),
            ({"name": "SparseStructureFlowModel", "args": {"resolution": 32}}, "has resolution 32"),
            ({"name": "SLatFlowModel"}, "is a SLatFlowModel"),
        ]
    ):
        config = {"models": {"denoiser": model}}
        fails(write_run(tmp_path / str(number), config, denoiser_step0001000=trained(FLOW)), part)


def test_a_flow_of_normalised_latents_is_refused(tmp_path: Path) -> None:
    normalised = {"dataset": {"args": {"normalization": {"mean": [0.0] * 8, "std": [2.0] * 8}}}}
    folder = write_run(tmp_path / "run", normalised, denoiser_step0001000=trained(FLOW))
    fails(folder, "was trained on normalised latents")


def test_the_latents_of_a_trained_slat_flow_are_normalised_as_its_run_says(tmp_path: Path) -> None:
    network = published_slat.modules(SMALL_SLAT_FLOW, SMALL_SLAT_VAE)[published_slat.FLOW]
    generator = torch.Generator().manual_seed(0)
    tensors = {name: torch.randn(t.shape, generator=generator) for name, t in network.state_dict().items()}
    config = {
        "models": {"denoiser": {"name": "ElasticSLatFlowModel"}},
        "dataset": {"args": {"normalization": {"mean": list(range(8)), "std": [0.5] * 8}}},
    }
    folder = write_run(tmp_path / "run", config, denoiser_step0001000=tensors)
    out = tmp_path / "out.safetensors"
    networks = slat_networks(SMALL_SLAT_FLOW, SMALL_SLAT_VAE)
    import_networks(folder, networks, out)
    stored = load_file(out)
    assert stored["stage_two.normalisation.mean"].tolist() == list(range(8))
    assert stored["stage_two.normalisation.std"].tolist() == [0.5] * 8
    config["dataset"] = {"args": {"normalization": {"mean": [0.0]}}}
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(ModelError, match=r"normalization in its training's config\.json cannot be read"):
        import_networks(folder, networks, out)


def test_a_published_embedding_is_checked_also_here(tmp_path: Path) -> None:
    tensors = trained(FLOW)
    tensors["pos_emb"] = tensors["pos_emb"].flip(0)
    fails(write_run(tmp_path / "run", {}, denoiser_step0001000=tensors), "pos_emb differs")
