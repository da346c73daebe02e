"""The frozen encoders of images and hands that a configuration names, and the trained aggregator over them."""

from dataclasses import dataclass
from typing import Annotated

from model.encoders.aggregator import AggregatorConfig, FeatureAggregator
from model.encoders.cached import CachedEncoder
from model.encoders.dino import DinoConfig, load_dino
from model.encoders.efficientnet import EfficientNetConfig, load_efficientnet
from model.encoders.hand import HandEncoder, packaged_hand_net, packaged_hand_sha256
from model.encoders.protocol import FeatureEncoder
from model.encoders.wilor import WilorConfig, load_wilor
from model.errors import ModelError
from shards.settings import Range

__all__ = [
    "EncodersConfig",
    "OwnHandEncoder",
    "PackagedHandEncoder",
    "aggregator_over",
    "encoder_digests",
    "given_hand_encoder",
    "image_encoder",
    "with_cache",
]


@dataclass(frozen=True, kw_only=True)
class OwnHandEncoder:
    """The hand encoder that this configuration trains, on a token grid of its own."""

    own_grid: Annotated[int, Range(1, 1024)]


@dataclass(frozen=True, kw_only=True)
class PackagedHandEncoder:
    """The hand encoder that ships with the package, on a token grid of its own."""

    packaged_grid: Annotated[int, Range(1, 1024)]


@dataclass(frozen=True, kw_only=True)
class EncodersConfig:
    """Frozen encoders of the images."""

    image: EfficientNetConfig | DinoConfig
    hand: OwnHandEncoder | PackagedHandEncoder | WilorConfig
    # images whose features are kept; of use where crops repeat, 0: none
    cached_views: Annotated[int, Range(0, 1_000_000_000)]


def encoder_digests(encoders: EncodersConfig) -> tuple[str, ...]:
    """Digest of the packaged hand encoder, if it is used: it may change with the package."""
    return (packaged_hand_sha256(),) if isinstance(encoders.hand, PackagedHandEncoder) else ()


def image_encoder(config: EncodersConfig) -> FeatureEncoder:
    """DINOv2 or EfficientNet. ModelError when its weights are missing."""
    chosen = config.image
    encoder: FeatureEncoder = (
        load_dino(chosen) if isinstance(chosen, DinoConfig) else load_efficientnet(chosen)
    )
    return with_cache(encoder, config)


def given_hand_encoder(config: EncodersConfig) -> FeatureEncoder:
    """The packaged one or WiLoR. ModelError for the one that stage 1 trains, or when weights are missing."""
    chosen = config.hand
    if isinstance(chosen, OwnHandEncoder):
        raise ModelError(
            "encoders.hand",
            "is the hand encoder that stage 1 trains",
            expected="one that is there already: {packaged_grid: N}, or WiLoR",
            action="Change it; stage 2 trains no hand encoder.",
        )
    if isinstance(chosen, PackagedHandEncoder):
        return with_cache(HandEncoder(network=packaged_hand_net(), grid=chosen.packaged_grid), config)
    return with_cache(load_wilor(chosen), config)


def aggregator_over(
    image: FeatureEncoder, hand: FeatureEncoder, *, hand_width: int, hidden: int, channels: int
) -> FeatureAggregator:
    """An untrained aggregator of the sizes that two encoders ask for."""
    return FeatureAggregator(
        AggregatorConfig(
            image_channels=image.channels,
            image_grid=image.grid,
            hand_channels=hand.channels,
            hand_grid=hand.grid,
            hand_width=hand_width,
            hidden=hidden,
            channels=channels,
        )
    )


def with_cache(encoder: FeatureEncoder, config: EncodersConfig) -> FeatureEncoder:
    """Keeps the features of `cached_views` images, of use where crops repeat."""
    return CachedEncoder(encoder=encoder, max_views=config.cached_views) if config.cached_views else encoder
