"""Where published weights lie on a disk: every place that people name is found, or said what is wrong with it."""

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from model.weights.importing import ImportReport, import_networks
from model.weights.source import PublishedFiles, find_published
from model.weights.trellis import stage_one_networks
from tests.model.weights.published import (
    CLASSES,
    DECODER,
    ENCODER,
    FLOW,
    SMALL_FLOW,
    SMALL_VAE,
    refused,
    write_published,
)

COMMITS = ("25e0d31ffbebe4b5a97464dd851910efc3002d96", "0123456789abcdef0123456789abcdef01234567")
MODEL = "models--microsoft--TRELLIS-image-large"
NETWORKS = stage_one_networks(SMALL_FLOW, SMALL_VAE)


def found(source: Path) -> PublishedFiles:
    return find_published(source, NETWORKS)


def run(source: Path, out: Path) -> ImportReport:
    return import_networks(source, NETWORKS, out)


def fails(source: Path, *parts: str) -> str:
    out = source.parent / "out.safetensors"
    return refused(lambda: run(source, out), out, *parts)


def files_in(folder: Path) -> dict[str, Path]:
    return {name: folder / f"{name}_fp16.safetensors" for name in CLASSES}


def cached(hub: Path, *commits: str, main: str = "", model: str = MODEL) -> Path:
    """A model in a cache as huggingface_hub lays it out: names in snapshots are relative links into blobs."""
    root = hub / model
    (root / "blobs").mkdir(parents=True)
    write_published(hub / "plain")
    for commit in commits:
        (root / "snapshots" / commit / "ckpts").mkdir(parents=True)
    for number, path in enumerate(sorted((hub / "plain").iterdir())):
        blob = root / "blobs" / f"{number:064d}"
        blob.write_bytes(path.read_bytes())
        for commit in commits:
            (root / "snapshots" / commit / "ckpts" / path.name).symlink_to(f"../../../blobs/{blob.name}")
    shutil.rmtree(hub / "plain")
    if main:
        (root / "refs").mkdir()
        (root / "refs" / "main").write_text(main)
    return root


def test_a_model_in_the_cache_is_found_from_every_folder_around_it(tmp_path: Path) -> None:
    root = cached(tmp_path / "huggingface" / "hub", COMMITS[0], main=COMMITS[0] + "\n")
    snapshot = root / "snapshots" / COMMITS[0]
    for source in (root, root / "snapshots", root.parent, root.parent.parent, snapshot, snapshot / "ckpts"):
        assert found(source).found == files_in(snapshot / "ckpts")
    assert found(root).notes == (f"read from snapshot {COMMITS[0][:12]}",)
    assert not found(snapshot).notes
    report = run(root, tmp_path / "out.safetensors")
    assert (len(report.imported), report.absent, report.ignored) == (3, (), ())


def test_of_several_snapshots_refs_main_names_the_one(tmp_path: Path) -> None:
    root = cached(tmp_path, *COMMITS, main=COMMITS[1])
    assert found(root).found == files_in(root / "snapshots" / COMMITS[1] / "ckpts")
    assert found(root).notes == (f"read from snapshot {COMMITS[1][:12]} of 2, as refs/main says",)
    for commit in COMMITS:  # named by the user
        assert found(root / "snapshots" / commit).found == files_in(root / "snapshots" / commit / "ckpts")
    (root / "refs" / "main").write_text("f" * 40)
    fails(
        root,
        "holds 2 snapshots",
        *COMMITS,
        "refs/main names ffff",
        f"Give the one that you want: {root}/snapshots/",
    )
    shutil.rmtree(root / "refs")
    fails(root, "refs/main names none")
    shutil.rmtree(root / "snapshots" / COMMITS[0])
    assert found(root).found == files_in(root / "snapshots" / COMMITS[1] / "ckpts")


def test_a_cache_of_several_models_is_asked_about(tmp_path: Path) -> None:
    root = cached(tmp_path, COMMITS[0])
    other = cached(tmp_path, COMMITS[0], model="models--facebook--dinov2-large")
    assert found(tmp_path).found == files_in(root / "snapshots" / COMMITS[0] / "ckpts")
    shutil.move(root, tmp_path / "models--someone--finetuned")
    fails(tmp_path, "is the cache of the hub with 2 models", other.name, "Give its folder")
    shutil.rmtree(other / "snapshots")
    (other / "snapshots").mkdir()
    fails(other, "without a snapshot", "did not finish")


def test_unfinished_downloads_are_said(tmp_path: Path) -> None:
    root = cached(tmp_path / "hub", COMMITS[0])
    ckpts = root / "snapshots" / COMMITS[0] / "ckpts"
    blob = root / "blobs" / f"{'9' * 64}.1a2b3c4d.incomplete"
    blob.write_bytes(b"x")
    (ckpts / f"{FLOW}_fp16.safetensors").unlink()  # the link comes when the blob is whole
    assert f"not downloaded completely: {blob}" in found(root).notes
    assert FLOW not in found(root).found
    for path in ckpts.glob("*.safetensors"):
        path.unlink()
    fails(root, "its download is not complete (1 files, first", "incomplete")
    local = tmp_path / "local"
    write_published(local / "ckpts")
    (local / ".cache/huggingface/download/ckpts").mkdir(parents=True)
    (local / ".cache/huggingface/download/ckpts/ab.cd.incomplete").touch()
    (local / "ckpts" / "other.safetensors.crdownload").touch()
    assert len([note for note in found(local).notes if "not downloaded completely" in note]) == 2


def test_a_link_whose_blob_is_gone_is_named(tmp_path: Path) -> None:
    root = cached(tmp_path, COMMITS[0])
    for blob in (root / "blobs").iterdir():
        blob.unlink()
    fails(root, f"{FLOW}_fp16.safetensors: is a link to ../../../blobs/", "The download is not complete")


def test_aria2_is_not_believed_before_it_is_done(tmp_path: Path) -> None:
    """It writes at full length, zeros where nothing has come yet: a file that would load."""
    tensors = write_published(tmp_path / "in")[ENCODER]
    save_file(
        {name: torch.zeros_like(t) for name, t in tensors.items()},
        tmp_path / f"in/{ENCODER}_fp16.safetensors",
    )
    (tmp_path / "in" / f"{ENCODER}_fp16.safetensors.aria2").touch()
    fails(tmp_path / "in", f"{ENCODER}_fp16.safetensors: is still being downloaded", ".aria2 lies beside it")


@pytest.mark.parametrize(
    ("name", "release"),
    [
        ("ss_flow_txt_dit_XL_16l8_fp16", "TRELLIS-text"),
        ("slat_flow_txt_dit_B_64l8p2_fp16", "TRELLIS-text"),
        ("ss_flow_img_dit_1_3B_64_bf16", "TRELLIS.2"),
        ("slat_flow_img2shape_dit_1_3B_512_bf16", "TRELLIS.2"),
        ("tex_dec_next_dc_f16c32_fp16", "TRELLIS.2"),
    ],
)
def test_another_release_is_named(tmp_path: Path, name: str, release: str) -> None:
    path = tmp_path / "in" / "ckpts" / f"{name}.safetensors"
    path.parent.mkdir(parents=True)
    save_file({"x": torch.zeros(1)}, path)
    for source in (tmp_path / "in", path.parent, path):
        fails(source, f"is of another release, {release}", "expected weights of TRELLIS-image-large")
    write_published(path.parent)  # the VAE of TRELLIS-text is this one
    assert found(tmp_path / "in").found == files_in(path.parent)


def test_copies_and_precisions_are_the_same_network(tmp_path: Path) -> None:
    write_published(tmp_path / "in")
    first = tmp_path / "in" / f"{DECODER}_fp16.safetensors"
    for name in (f"{DECODER}.safetensors", f"{DECODER}_bf16.pt", f"{DECODER}_fp16 (1).safetensors"):
        second = first.with_name(name)
        second.write_bytes(first.read_bytes())
        fails(tmp_path / "in", f"holds {DECODER} twice", first.name, name, "Move one of them elsewhere")
        second.unlink()
    first.rename(first.with_name(f"{DECODER}2_fp16.safetensors"))  # another network
    assert DECODER not in found(tmp_path / "in").found


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
def test_every_precision_is_taken_as_it_is(tmp_path: Path, dtype: torch.dtype) -> None:
    tensors = {name: t.to(dtype) for name, t in write_published(tmp_path / "in")[FLOW].items()}
    path = tmp_path / "in" / f"{FLOW}_fp16.safetensors"
    save_file(tensors, path)
    run(path, tmp_path / "out.safetensors")
    for name, tensor in load_file(tmp_path / "out.safetensors").items():
        assert tensor.dtype == dtype
        assert torch.equal(tensor, tensors[name.removeprefix("flow.geometry.")])


def test_a_single_file_of_any_name_is_known_by_its_tensors(tmp_path: Path) -> None:
    tensors = write_published(tmp_path / "in")[ENCODER]
    blob = tmp_path / ("0" * 64)
    (tmp_path / "in" / f"{ENCODER}_fp16.safetensors").rename(blob)
    assert found(blob).found == {ENCODER: blob}
    assert found(blob).notes == (f"{blob.name} is taken for {ENCODER}, by the names of its tensors",)
    del tensors["input_layer.bias"]
    save_file(tensors, blob)
    fails(
        blob,
        "is none of the published networks",
        f"as {ENCODER} it would have 1 missing (input_layer.bias), 0 un",
    )
    save_file({"x": torch.zeros(1)}, blob)
    fails(blob, "none of its 1 tensors has a name of theirs, first x")


def in_parts(path: Path, tensors: dict[str, torch.Tensor], n: int, *, index: bool) -> None:
    """As huggingface_hub splits a state dict."""
    names = sorted(tensors)
    parts = {f"{path.stem}-{i + 1:05d}-of-{n:05d}.safetensors": names[i::n] for i in range(n)}
    for part, keys in parts.items():
        save_file({key: tensors[key] for key in keys}, path.with_name(part))
    if index:
        weight_map = {key: part for part, keys in parts.items() for key in keys}
        content = {"metadata": {"total_size": 1}, "weight_map": weight_map}
        path.with_name(f"{path.name}.index.json").write_text(json.dumps(content))


@pytest.mark.parametrize("index", [True, False])
def test_a_file_in_parts_is_one_network(tmp_path: Path, index: bool) -> None:
    tensors = write_published(tmp_path / "in")[FLOW]
    path = tmp_path / "in" / f"{FLOW}_fp16.safetensors"
    path.unlink()
    in_parts(path, tensors, 3, index=index)
    part = path.with_name(f"{FLOW}_fp16-00002-of-00003.safetensors")
    for source in (tmp_path / "in", part):
        report = run(source, tmp_path / "out.safetensors")
        stored = load_file(tmp_path / "out.safetensors")
        assert all(torch.equal(stored[f"flow.geometry.{name}"], tensor) for name, tensor in tensors.items())
        assert FLOW in {file.network for file in report.imported}
        (tmp_path / "out.safetensors").unlink()
    part.rename(tmp_path / "elsewhere")
    fails(tmp_path / "in", f"{part.name}: there is no such file")


def test_an_index_that_points_elsewhere_or_is_damaged(tmp_path: Path) -> None:
    tensors = write_published(tmp_path / "in")[FLOW]
    path = tmp_path / "in" / f"{FLOW}_fp16.safetensors"
    path.unlink()
    in_parts(path, tensors, 2, index=True)
    index = path.with_name(f"{path.name}.index.json")
    for content in (
        "{}",
        '{"weight_map": {"x": "../out"}}',
        '{"weight_map": {"x": 3}}',
        '{"weight_map": []}',
    ):
        index.write_text(content)
        fails(tmp_path / "in", index.name, "has no weight_map to files of its own folder")
    for content, what in (
        ("<html>", "web page"),
        ("../../blobs/0f", "text of a link"),
        ("[", "Expecting value"),
    ):
        index.write_text(content)
        fails(tmp_path / "in", index.name, "cannot be read", what)
    index.unlink()
    part = path.with_name(f"{FLOW}_fp16-00002-of-00002.safetensors")
    save_file({"out_layer.bias": tensors["out_layer.bias"], "pos_emb": tensors["pos_emb"]}, part)
    fails(tmp_path / "in", "is in both")


def test_names_of_wrapped_modules_lose_their_prefix_with_a_note(tmp_path: Path) -> None:
    tensors = write_published(tmp_path / "in")[ENCODER]
    path = tmp_path / "in" / f"{ENCODER}_fp16.safetensors"
    for prefix in ("module.", "_orig_mod.", "module._orig_mod.", "_orig_mod.module."):
        save_file({prefix + name: tensor for name, tensor in tensors.items()}, path)
        report = run(path, tmp_path / "out.safetensors")
        assert report.notes == (f"{path.name}: every name without its '{prefix}'",)
        stored = load_file(tmp_path / "out.safetensors")
        assert all(torch.equal(stored[f"vae.encoder.{name}"], tensor) for name, tensor in tensors.items())
        (tmp_path / "out.safetensors").unlink()
    save_file({name if "bias" in name else f"module.{name}": t for name, t in tensors.items()}, path)
    fails(path, "missing", "unused (module.")


def test_pointers_pages_pipes_and_folders_in_place_of_a_file(tmp_path: Path) -> None:
    write_published(tmp_path / "in")
    path = tmp_path / "in" / f"{FLOW}_fp16.safetensors"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1130770840\n")
    for source in (tmp_path / "in", path):
        fails(source, str(path), "Git LFS pointer", "git lfs pull")
    path.write_text("<!doctype html><title>Sign in</title>")
    fails(tmp_path / "in", "web page")
    path.unlink()
    path.symlink_to("../.git/annex/objects/Kx/2Q/SHA256E-s1--4d/SHA256E-s1--4d.safetensors")
    fails(tmp_path / "in", "is a link to ../.git/annex/objects/", "there is no file")
    path.unlink()
    os.mkfifo(path)
    for source in (tmp_path / "in", path):
        fails(source, str(path), "is a named pipe")
    path.unlink()
    path.mkdir()
    fails(tmp_path / "in", str(path), "is a folder, not a file")


def test_sources_that_are_nothing_to_read(tmp_path: Path) -> None:
    fails(tmp_path / "none", "there is no such file or folder", "microsoft/TRELLIS-image-large/ckpts")
    fails(tmp_path / ("long" * 100), "cannot be read (File name too long)")
    link = tmp_path / "link"
    link.symlink_to("nowhere")
    fails(link, "is a link to something that is not there")
    (tmp_path / "clone" / "TRELLIS-image-large" / "ckpts").mkdir(parents=True)
    fails(tmp_path / "clone", f"Give {tmp_path}/clone/TRELLIS-image-large.")
    save_file({"x": torch.zeros(1)}, tmp_path / "clone" / "x.safetensors")
    (tmp_path / "clone" / f"._{FLOW}_fp16.safetensors").touch()  # of a Mac
    shutil.rmtree(tmp_path / "clone" / "TRELLIS-image-large")
    fails(
        tmp_path / "clone",
        "holds none of the published networks among 1 files of weights, first x.safetensors",
    )


@pytest.fixture
def unprivileged() -> Iterator[None]:
    """Root may read everything: the test goes on as nobody."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


def test_what_may_not_be_read_is_said(
    tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest
) -> None:
    folder = tmp_path_factory.mktemp("private")
    write_published(folder / "in")
    for place in (folder / "in" / f"{FLOW}_fp16.safetensors", folder / "in"):
        place.chmod(0)
    request.getfixturevalue("unprivileged")
    for source in (folder / "in", folder / "in" / f"{FLOW}_fp16.safetensors"):
        with pytest.raises(ValueError, match=r"Permission denied\)"):
            found(source)


def test_names_that_are_no_utf_8_and_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    write_published(tmp_path / "in")
    (tmp_path / "in").rename(folder)
    fails(folder, "its path holds bytes that are no UTF-8", "Rename")
    folder.rename(tmp_path / "in")
    (tmp_path / "file").touch()
    out = tmp_path / "file" / "out.safetensors"
    refused(lambda: run(tmp_path / "in", out), tmp_path / "none", f"{out}: cannot be written")
