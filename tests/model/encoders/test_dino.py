"""DINOv2 with registers, at toy size, from a folder."""

from pathlib import Path

import pytest
import torch
from torch.nn import functional
from transformers import Dinov2WithRegistersConfig, Dinov2WithRegistersModel, ViTConfig, ViTModel

from model.encoders.dino import DinoConfig, DinoEncoder, load_dino
from model.encoders.protocol import FeatureEncoder
from model.errors import ModelError
from tests.model.encoders.drawn import blob_image


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random network of the layout of the published one: patch 14, 37 x 37 positions, 4 registers."""
    torch.manual_seed(0)
    config = Dinov2WithRegistersConfig(
        hidden_size=32,
        num_hidden_layers=2,
        num_attention_heads=4,
        image_size=518,
        patch_size=14,
        num_register_tokens=4,
        mlp_ratio=2,
        initializer_range=0.1,
    )
    path = tmp_path_factory.mktemp("dino")
    Dinov2WithRegistersModel(config).save_pretrained(path)
    return path


def loaded(folder: Path, image_size: int) -> DinoEncoder:
    return load_dino(DinoConfig(source=folder, image_size=image_size, local_files_only=True))


def test_518_gives_37_by_37_tokens(folder: Path) -> None:
    encoder = loaded(folder, 518)
    assert isinstance(encoder, FeatureEncoder)
    tokens = encoder(torch.rand(1, 2, 3, 518, 518))
    assert (encoder.grid, encoder.channels) == (37, 32)
    assert tokens.shape == (1, 2, 37 * 37, 32)
    assert tokens.dtype == torch.float32


def test_tokens_are_trelliss_conditioning_without_cls_and_registers(folder: Path) -> None:
    """Un-affine layer norm of the tokens before the last norm (FORMATS 4.5)."""
    torch.manual_seed(1)
    images = torch.rand(1, 1, 3, 518, 518)
    tokens = loaded(folder, 518)(images)
    network = Dinov2WithRegistersModel.from_pretrained(folder).eval()
    captured: list[torch.Tensor] = []
    network.layernorm.register_forward_pre_hook(lambda _, inputs: captured.append(inputs[0]))
    mean = torch.tensor([0.485, 0.456, 0.406]).reshape(3, 1, 1)
    std = torch.tensor([0.229, 0.224, 0.225]).reshape(3, 1, 1)
    with torch.no_grad():
        network((images[0] - mean) / std)
    prenorm = captured[0]
    assert prenorm.shape[1] == 1 + 4 + 1369
    torch.testing.assert_close(tokens[0], functional.layer_norm(prenorm, (32,))[:, 5:])


def test_a_lit_patch_moves_its_own_token_most(folder: Path) -> None:
    encoder = loaded(folder, 140)
    row, column = 2, 7
    with_spot = blob_image(140, (column + 0.5) / 10, (row + 0.5) / 10, 0.02)
    tokens = encoder(torch.stack([torch.full_like(with_spot, 0.5), with_spot])[None])[0]
    change = (tokens[1] - tokens[0]).norm(dim=-1)
    assert encoder.grid == 10
    assert int(change.argmax()) == row * 10 + column


def test_other_sizes_are_resized(folder: Path) -> None:
    encoder = loaded(folder, 140)
    image = blob_image(280, 0.3, 0.6, 0.2)
    small = torch.nn.functional.interpolate(image[None], size=140, mode="bicubic", antialias=True)[0]
    torch.testing.assert_close(encoder(image[None, None]), encoder(small.clamp(0, 1)[None, None]))


def test_frozen_deterministic_and_in_bfloat16(folder: Path) -> None:
    encoder = loaded(folder, 140)
    images = torch.rand(1, 1, 3, 140, 140, requires_grad=True)
    tokens = encoder(images)
    assert not tokens.requires_grad
    assert not any(p.requires_grad for p in encoder.network.parameters())
    assert not encoder.network.training
    assert torch.equal(tokens, encoder(images))
    half = encoder.to("cpu", torch.bfloat16)(images.detach().bfloat16())
    assert half.dtype == torch.bfloat16
    assert functional.cosine_similarity(half.float(), tokens, dim=-1).mean() > 0.98


@pytest.mark.parametrize("source", ["/nowhere/dino", "no-one/no-such-network"])
def test_nothing_there_names_what_to_download(source: str) -> None:
    with pytest.raises(ModelError) as caught:
        load_dino(DinoConfig(source=source, image_size=518, local_files_only=True))
    message = str(caught.value)
    assert message.startswith(source)
    assert "hf download facebook/dinov2-with-registers-large" in message
    assert "\n" not in message


def test_another_network_is_refused(tmp_path: Path) -> None:
    config = ViTConfig(
        hidden_size=16, num_hidden_layers=1, num_attention_heads=2, intermediate_size=16, image_size=28
    )
    ViTModel(config).save_pretrained(tmp_path)
    with pytest.raises(ModelError, match="the network is 'vit'"):
        loaded(tmp_path, 518)


def test_other_patches_are_refused(tmp_path: Path) -> None:
    config = Dinov2WithRegistersConfig(
        hidden_size=16, num_hidden_layers=1, num_attention_heads=2, image_size=64, patch_size=16
    )
    Dinov2WithRegistersModel(config).save_pretrained(tmp_path)
    with pytest.raises(ModelError, match="its patches are 16 px wide and not 14"):
        loaded(tmp_path, 518)


def test_missing_weights_are_refused(folder: Path, tmp_path: Path) -> None:
    network = Dinov2WithRegistersModel.from_pretrained(folder)
    state = {name: value for name, value in network.state_dict().items() if "layer.1.mlp.fc1" not in name}
    network.save_pretrained(tmp_path, state_dict=state)
    with pytest.raises(ModelError, match=r"2 weights are missing, first encoder\.layer\.1\.mlp\.fc1"):
        loaded(tmp_path, 518)


@pytest.mark.parametrize("image_size", [0, 520])
def test_a_size_that_patches_do_not_divide_is_refused_before_anything_is_loaded(image_size: int) -> None:
    with pytest.raises(ModelError, match="multiple of the patch size 14"):
        DinoConfig(source="/nowhere", image_size=image_size, local_files_only=True)
