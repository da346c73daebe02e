"""The cache gives what the encoder gives, and asks it once."""

from dataclasses import dataclass, field

import pytest
import torch

from model.encoders.cached import CachedEncoder
from model.encoders.protocol import FeatureEncoder


@dataclass(frozen=True, kw_only=True)
class Means:
    """Mean colour of each quarter; counts the views it was asked for."""

    grid: int = 2
    channels: int = 3
    asked: list[int] = field(default_factory=list)

    def to(self, device: torch.device | str, dtype: torch.dtype) -> "Means":
        return self

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        self.asked.append(images.shape[0] * images.shape[1])
        pooled = torch.nn.functional.adaptive_avg_pool2d(images.flatten(0, 1), 2)
        return pooled.flatten(2).transpose(1, 2).unflatten(0, images.shape[:2])


def test_each_image_is_computed_once() -> None:
    inner = Means()
    cached = CachedEncoder(encoder=inner, max_views=100)
    assert isinstance(cached, FeatureEncoder)
    images = torch.rand(2, 3, 3, 8, 8)
    images[1, 2] = images[0, 0]
    assert torch.equal(cached(images), inner(images))
    assert torch.equal(cached(images.flip(0)), inner(images.flip(0)))
    assert torch.equal(cached(images[:1, :1]), inner(images[:1, :1]))
    assert inner.asked == [5, 6, 6, 1]  # of these only the 5 by the cache


def test_other_images_other_features_and_no_more_than_allowed() -> None:
    inner = Means()
    cached = CachedEncoder(encoder=inner, max_views=2)
    images = torch.rand(1, 3, 3, 8, 8)
    first = cached(images)
    changed = images.clone()
    changed[0, 0, 0, 0, 0] += 0.5
    assert not torch.equal(cached(changed)[0, 0], first[0, 0])
    assert inner.asked == [3, 2]  # the changed one, and the third, which did not fit


def test_moving_forgets() -> None:
    inner = Means()
    cached = CachedEncoder(encoder=inner, max_views=9)
    images = torch.rand(1, 1, 3, 8, 8)
    cached(images)
    cached.to("cpu", torch.float32)(images)
    assert inner.asked == [1, 1]
    assert cached(images.bfloat16()).dtype == torch.bfloat16


@dataclass(frozen=True, kw_only=True)
class Weighted(Means):
    """Has weights, as every encoder does: autocast would change the type that it computes in."""

    layer: torch.nn.Linear = field(default_factory=lambda: torch.nn.Linear(3, 3).requires_grad_(False))

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        return self.layer(super().__call__(images))


@pytest.mark.parametrize("autocast_first", [True, False])
def test_features_do_not_depend_on_who_asked_first(autocast_first: bool) -> None:
    inner = Weighted()
    cached = CachedEncoder(encoder=inner, max_views=1)  # one kept, one computed each time
    images = torch.rand(1, 2, 3, 8, 8)
    for autocast in (autocast_first, not autocast_first):
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            tokens = cached(images)
        assert tokens.dtype == torch.float32
        # Products of one view and of two are summed in another order: 1e-6 for three terms; bfloat16 rounds to 4e-3.
        torch.testing.assert_close(tokens, inner(images), rtol=0.0, atol=1e-6)
