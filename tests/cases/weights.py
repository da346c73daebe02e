"""Weights as they lie on disks: the cache of the hub, trainings of TRELLIS, downloads that did not finish."""

import tempfile
from functools import cache
from pathlib import Path

from model.errors import ModelError
from model.recipes.config import load_config
from model.weights.importing import import_networks
from model.weights.published import PublishedNetwork
from model.weights.source import find_published
from tests.cases.outcome import Case

__all__ = ["CASES"]

COMMIT = "25e0d31ffbebe4b5a97464dd851910efc3002d96"
MODEL = "models--microsoft--TRELLIS-image-large"


@cache
def stage_one() -> tuple[PublishedNetwork, ...]:
    return tuple(load_config("paper").published_networks())


def imported(source: Path) -> str:
    with tempfile.TemporaryDirectory() as folder:
        report = import_networks(source, stage_one(), Path(folder) / "out.safetensors")
    return f"imported {len(report.imported)} networks"


def refusal(source: Path) -> str:
    """What the import says; it must refuse."""
    try:
        done = imported(source)
    except ModelError as error:
        return str(error)
    raise AssertionError(done)


def hub_cache(folder: Path) -> str:
    """The model's folder, the cache around it and the snapshot are the same three files."""
    snapshot = folder / MODEL / "snapshots" / COMMIT
    wanted = {
        network.name: snapshot / "ckpts" / f"{network.name}_fp16.safetensors" for network in stage_one()
    }
    assert len(wanted) == 3
    for source in (folder / MODEL, folder, folder / MODEL / "snapshots", snapshot, snapshot / "ckpts"):
        found = find_published(source, stage_one()).found
        assert found == wanted, (source, found)
    text = refusal(folder / MODEL)  # the blobs are tiny
    if next(iter(wanted.values())).is_symlink():
        assert "input_layer.weight (4, 8) in the file, (1024, 8) in the module" in text, text
        assert "488 missing" in text, text
    else:  # copied by something that writes links as text
        assert "the text of a link to ../../../blobs/" in text, text
    return "3 networks in the snapshot, from every folder around it"


def trained_run(folder: Path) -> str:
    text = refusal(folder / "run")
    assert "output of a training of TRELLIS with 2 checkpoints" in text, text
    assert "Give one of them as a file, for example" in text, text
    assert "denoiser_ema0.9999_step0001000.pt" in text, text
    return text


def optimiser(folder: Path) -> str:
    text = refusal(folder / "run" / "ckpts" / "misc_step0001000.pt")
    assert "optimiser's state" in text, text
    return text


def damaged_checkpoint(folder: Path) -> str:
    """64 bytes that begin like a zip archive."""
    text = refusal(folder / "run" / "ckpts" / "denoiser_ema0.9999_step0001000.pt")
    assert "cut off after 64 bytes" in text, text
    return text


def truncated(folder: Path) -> str:
    """A header of 8 + 72 bytes that announces 64 x 64 float16."""
    source = folder / "TRELLIS-image-large"
    text = refusal(source)
    n_bytes = (source / "ckpts" / "ss_flow_img_dit_L_16l8_fp16.safetensors").stat().st_size
    assert f"it has {n_bytes} of {8 + 72 + 2 * 64 * 64} bytes: an interrupted download" in text, text
    return text


def two_precisions(folder: Path) -> str:
    text = refusal(folder / "TRELLIS-image-large")
    assert "holds ss_flow_img_dit_L_16l8 twice" in text, text
    assert "_fp16.safetensors" in text, text
    assert "_bf16.safetensors" in text, text
    return text


def other_release(folder: Path) -> str:
    for name, release in (("TRELLIS.2-4B", "TRELLIS.2"), ("TRELLIS-text-large", "TRELLIS-text")):
        for source in (
            folder / name,
            folder / name / "ckpts",
            *(folder / name / "ckpts").glob("*.safetensors"),
        ):
            text = refusal(source)
            assert f"is of another release, {release}" in text, text
            assert "expected weights of TRELLIS-image-large" in text, text
    return "each is named, and TRELLIS-image-large asked for"


CASES = (
    Case(folder="w01_hub_cache_root", what="a model in the cache of the hub", check=hub_cache),
    Case(folder="w02_finetuned_run", what="a training of TRELLIS is asked about", check=trained_run),
    Case(folder="w02_finetuned_run", what="its optimiser is refused by name", check=optimiser),
    Case(folder="w02_finetuned_run", what="a damaged checkpoint", check=damaged_checkpoint),
    Case(
        folder="w02_finetuned_run",
        what="a training of TRELLIS",
        check=lambda folder: imported(folder / "run"),
        refused_is_right=True,
    ),
    Case(folder="w04_truncated", what="an interrupted download", check=truncated),
    Case(folder="w05_two_precisions", what="one network in two precisions", check=two_precisions),
    Case(folder="w06_other_release", what="another release of TRELLIS", check=other_release),
)
