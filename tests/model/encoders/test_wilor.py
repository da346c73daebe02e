"""WiLoR's backbone from a checkpoint of its layout, at toy width; names and sizes at full width."""

import os
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch
from torch import nn
from torch.nn import functional

from model.encoders.checkpoint import load_state_dict
from model.encoders.protocol import FeatureEncoder
from model.encoders.wilor import (
    WILOR_LAYOUT,
    WilorBackbone,
    WilorConfig,
    WilorEncoder,
    WilorLayout,
    load_wilor,
)
from model.errors import ModelError
from tests.model.encoders.drawn import blob_image

TOY = WilorLayout(
    image_height=256, image_width=192, patch=16, channels=32, depth=3, heads=4, mlp_ratio=2, joints=16
)


def published_shapes(layout: WilorLayout) -> dict[str, tuple[int, ...]]:
    """The backbone's tensors as the published source creates them (FORMATS 5; WiLoR @819369a)."""
    c, m = layout.channels, layout.mlp_ratio * layout.channels
    shapes: dict[str, tuple[int, ...]] = {
        "pos_embed": (1, 193, c),
        "init_cam": (1, 3),
        "init_hand_pose": (1, 96),
        "init_betas": (1, 10),
        "patch_embed.proj.weight": (c, 3, 16, 16),
        "patch_embed.proj.bias": (c,),
        "last_norm.weight": (c,),
        "last_norm.bias": (c,),
    }
    linear = {"pose_emb": (6, c), "shape_emb": (10, c), "cam_emb": (3, c)}
    linear |= {"decpose": (c, 6), "decshape": (c, 10), "deccam": (c, 3)}
    for i in range(layout.depth):
        shapes |= {
            f"blocks.{i}.{norm}.{kind}": (c,) for norm in ("norm1", "norm2") for kind in ("weight", "bias")
        }
        linear |= {f"blocks.{i}.attn.qkv": (c, 3 * c), f"blocks.{i}.attn.proj": (c, c)}
        linear |= {f"blocks.{i}.mlp.fc1": (c, m), f"blocks.{i}.mlp.fc2": (m, c)}
    for name, (inputs, outputs) in linear.items():
        shapes |= {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}
    return shapes


def lightning_content(layout: WilorLayout) -> dict[str, object]:
    generator = torch.Generator().manual_seed(0)
    shapes = published_shapes(layout)
    tensors = {f"backbone.{n}": 0.1 * torch.randn(shape, generator=generator) for n, shape in shapes.items()}
    for name in tensors:
        if "norm" in name and name.endswith("weight"):
            tensors[name] = tensors[name] + 1
    tensors |= {"refine_net.deconv.first.0.weight": torch.zeros(4), "mano.faces_tensor": torch.zeros(4, 3)}
    tensors["initialized"] = torch.tensor(False)
    module = nn.Module()  # state dicts of modules carry _metadata
    state = module.state_dict()
    state.update(tensors)
    return {
        "epoch": 3,
        "global_step": 7,
        "pytorch-lightning_version": "1.8",
        "state_dict": state,
        "callbacks": {},
    }


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """With hyper-parameters of a class that is not installed here, as in the published file."""
    module = ModuleType("yacs_not_here")

    class CfgNode(dict):
        def __init__(self, **values: object) -> None:
            super().__init__(values)
            self.__dict__["frozen"] = True

    CfgNode.__module__, CfgNode.__qualname__ = module.__name__, "CfgNode"
    module.CfgNode = CfgNode  # type: ignore[attr-defined]
    sys.modules[module.__name__] = module
    path = tmp_path / "wilor_final.ckpt"
    config = CfgNode(MODEL=CfgNode(IMAGE_SIZE=256), paths=[Path("/data")], kind=torch.float32)
    torch.save(lightning_content(TOY) | {"hyper_parameters": {"cfg": config}}, path)
    del sys.modules[module.__name__]
    return path


def loaded(path: Path, **changes: object) -> WilorEncoder:
    config = WilorConfig(checkpoint=path, image_size=224, grid=14, layout=TOY)
    return load_wilor(replace(config, **changes))  # type: ignore[arg-type]


def test_full_width_has_the_published_names_and_shapes() -> None:
    with torch.device("meta"):
        network = WilorBackbone(WILOR_LAYOUT)
    ours = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    published = published_shapes(WILOR_LAYOUT)
    read_out = {name for name in published if name.startswith(("decpose", "decshape", "deccam"))}
    assert ours == {name: shape for name, shape in published.items() if name not in read_out}
    assert sum(p.numel() for p in network.parameters()) == 630_940_160


def test_every_tensor_of_the_checkpoint_is_used_or_listed(checkpoint: Path) -> None:
    encoder = loaded(checkpoint)
    keys = encoder.keys
    everything = set(keys.used) | set(keys.unused_backbone) | set(keys.unused_other)
    content = lightning_content(TOY)["state_dict"]
    assert everything == set(content)  # type: ignore[call-overload]
    assert len(keys.used) + len(keys.unused_backbone) + len(keys.unused_other) == len(everything)
    decoders = ("decpose", "decshape", "deccam")
    assert set(keys.unused_backbone) == {
        f"backbone.{d}.{kind}" for d in decoders for kind in ("weight", "bias")
    }
    for name, tensor in encoder.network.state_dict().items():
        torch.testing.assert_close(tensor, content[f"backbone.{name}"], rtol=0, atol=0)  # type: ignore[index]


def reference_features(state: dict[str, torch.Tensor], pixels: torch.Tensor) -> torch.Tensor:
    """img_feat as the published description says, written with functions only (256 x 192 pixels)."""

    def linear(x: torch.Tensor, name: str) -> torch.Tensor:
        return x @ state[f"backbone.{name}.weight"].T + state[f"backbone.{name}.bias"]

    def norm(x: torch.Tensor, name: str) -> torch.Tensor:
        weight, bias = state[f"backbone.{name}.weight"], state[f"backbone.{name}.bias"]
        return functional.layer_norm(x, (TOY.channels,), weight, bias, 1e-6)

    proj = (state["backbone.patch_embed.proj.weight"], state["backbone.patch_embed.proj.bias"])
    patches = functional.conv2d(pixels, *proj, stride=16, padding=2).flatten(2).transpose(1, 2)
    position = state["backbone.pos_embed"]
    patches = patches + position[:, 1:] + position[:, :1]
    mano = [
        linear(state["backbone.init_hand_pose"].reshape(1, 16, 6), "pose_emb"),
        linear(state["backbone.init_betas"], "shape_emb")[:, None],
        linear(state["backbone.init_cam"], "cam_emb")[:, None],
    ]
    x = torch.cat([*mano, patches], dim=1)
    for i in range(TOY.depth):
        q, k, v = linear(norm(x, f"blocks.{i}.norm1"), f"blocks.{i}.attn.qkv").chunk(3, dim=-1)
        heads = []
        for h in range(TOY.heads):
            part = slice(8 * h, 8 * h + 8)
            weights = (q[..., part] @ k[..., part].transpose(1, 2) / 8**0.5).softmax(-1)
            heads.append(weights @ v[..., part])
        x = x + linear(torch.cat(heads, dim=-1), f"blocks.{i}.attn.proj")
        inner = functional.gelu(linear(norm(x, f"blocks.{i}.norm2"), f"blocks.{i}.mlp.fc1"))
        x = x + linear(inner, f"blocks.{i}.mlp.fc2")
    return norm(x, "last_norm")[:, 18:].transpose(1, 2).reshape(1, TOY.channels, 16, 12)


def test_features_at_wilors_own_size(checkpoint: Path) -> None:
    torch.manual_seed(0)
    pixels = torch.randn(1, 3, 256, 192)
    state = load_state_dict(checkpoint, action="")
    with torch.no_grad():
        ours = loaded(checkpoint).network(pixels)
    torch.testing.assert_close(ours, reference_features(state, pixels), rtol=1e-4, atol=1e-4)


def test_whole_crop_at_224_gives_14_by_14_tokens(checkpoint: Path) -> None:
    encoder = loaded(checkpoint)
    assert isinstance(encoder, FeatureEncoder)
    images = torch.rand(2, 3, 3, 224, 224)
    tokens = encoder(images)
    assert (encoder.grid, encoder.channels) == (14, 32)
    assert tokens.shape == (2, 3, 196, 32)
    assert torch.equal(tokens, encoder(images))
    assert loaded(checkpoint, grid=37)(images[:1, :1, :, :128, :128]).shape == (1, 1, 37 * 37, 32)


@pytest.mark.parametrize("grid", [14, 37])
def test_a_lit_patch_moves_the_tokens_around_it_most(checkpoint: Path, grid: int) -> None:
    encoder = loaded(checkpoint, grid=grid)
    x, y = (9 * 16 + 6) / 224, (4 * 16 + 6) / 224  # centre of patch (4, 9): patches start 2 px outside
    with_spot = blob_image(224, x, y, 0.015)
    tokens = encoder(torch.stack([torch.full_like(with_spot, 0.5), with_spot])[None])[0]
    row, column = divmod(int((tokens[1] - tokens[0]).norm(dim=-1).argmax()), grid)
    assert abs((column + 0.5) / grid - x) <= 0.5 / grid
    assert abs((row + 0.5) / grid - y) <= 0.5 / grid


def test_frozen_and_in_bfloat16(checkpoint: Path) -> None:
    encoder = loaded(checkpoint)
    images = torch.rand(1, 1, 3, 224, 224, requires_grad=True)
    tokens = encoder(images)
    assert not tokens.requires_grad
    assert not any(p.requires_grad for p in encoder.network.parameters())
    half = encoder.to("cpu", torch.bfloat16)(images.detach().bfloat16())
    assert half.dtype == torch.bfloat16
    assert functional.cosine_similarity(half.float(), tokens, dim=-1).mean() > 0.98


class Attack:
    """Runs a command when unpickled in the ordinary way."""

    def __init__(self, command: str) -> None:
        self.command = command

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (self.command,)


def test_nothing_in_the_file_is_run(tmp_path: Path) -> None:
    path, trace = tmp_path / "evil.ckpt", tmp_path / "trace"
    torch.save({"optimizer": Attack(f"touch {trace}")} | lightning_content(TOY), path)
    assert len(loaded(path).keys.used) > 10
    assert not trace.exists()


def test_a_tensor_made_by_a_foreign_function_is_no_tensor(tmp_path: Path) -> None:
    path, trace = tmp_path / "evil.ckpt", tmp_path / "trace"
    content = lightning_content(TOY)
    content["state_dict"]["backbone.pos_embed"] = Attack(f"touch {trace}")  # type: ignore[index]
    torch.save(content, path)
    with pytest.raises(ModelError, match="1 tensors of the backbone are missing, first pos_embed"):
        loaded(path)
    assert not trace.exists()


def test_missing_file_names_what_to_download(tmp_path: Path) -> None:
    with pytest.raises(
        ModelError, match=r"there is no such file; .* Download pretrained_models/wilor_final\.ckpt"
    ):
        loaded(tmp_path / "none.ckpt")


@pytest.mark.parametrize("content", [b"", b"<html>log in</html>", b"PK\x03\x04 broken"])
def test_other_files_are_one_clear_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "wilor_final.ckpt"
    path.write_bytes(content)
    with pytest.raises(ModelError, match="is no zip archive") as caught:
        loaded(path)
    assert "\n" not in str(caught.value)


def test_a_torchscript_program_is_not_opened(tmp_path: Path) -> None:
    path = tmp_path / "program.pt"
    torch.jit.trace(nn.Linear(2, 2), torch.zeros(1, 2)).save(path)
    with pytest.raises(ModelError, match="TorchScript"):
        load_state_dict(path, action="")


def test_a_zip_of_something_else(tmp_path: Path) -> None:
    path = tmp_path / "archive.ckpt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(ModelError, match="cannot be read"):
        loaded(path)


def test_another_layout_is_refused(checkpoint: Path) -> None:
    with pytest.raises(ModelError, match="first blocks.3.norm1.weight"):  # noqa: RUF043
        loaded(checkpoint, layout=replace(TOY, depth=4))
    with pytest.raises(ModelError, match="the backbone has 12 unknown tensors"):
        loaded(checkpoint, layout=replace(TOY, depth=2))
    with pytest.raises(ModelError, match="has shape"):
        loaded(checkpoint, layout=replace(TOY, channels=64))
