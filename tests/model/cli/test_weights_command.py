"""`forehoi weights import`: what is left out or guessed is a line each, whatever files are called."""

import os
from pathlib import Path

from model.recipes.config import load_config
from tests.model.small_run import forehoi
from tests.model.stages import stage_one
from tests.model.weights.published import ENCODER, write_published


def test_notes_are_lines_and_names_are_printed_as_they_are(tmp_path: Path) -> None:
    config = stage_one(load_config("tiny"))
    source, out = tmp_path / "in [bold]", tmp_path / "out.safetensors"
    write_published(source / "ckpts", config.stage_one.network, config.vae.network, std=0.1)
    (source / "ckpts" / f"{ENCODER}_fp16.safetensors").unlink()
    for name in (
        b"slat[red]\xff.safetensors",
        b"ss_flow_txt_dit_L_16l8_fp16.safetensors",
        b"x.safetensors.part",
    ):
        Path(os.fsdecode(os.fsencode(source / "ckpts") + b"/" + name)).touch()
    status, output = forehoi("weights", "import", source, "--config", "tiny", "--out", out)
    assert status == 0, output
    assert f"not downloaded completely: {source}/ckpts/x.safetensors.part" in output
    assert f"not of this stage: {source}/ckpts/slat[red]\\xff.safetensors" in output
    assert (
        f"of another release, TRELLIS-text: {source}/ckpts/ss_flow_txt_dit_L_16l8_fp16.safetensors" in output
    )
    assert f"not in {source}: {ENCODER}" in output
    assert f"wrote {out}" in output


def test_a_source_without_weights_is_one_line(tmp_path: Path) -> None:
    status, output = forehoi("weights", "import", tmp_path, "--out", tmp_path / "out.safetensors")
    assert status == 2
    (line,) = output.splitlines()
    assert line.startswith(f"forehoi: {tmp_path}: holds none of the published networks")
