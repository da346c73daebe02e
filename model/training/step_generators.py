"""Randomness of training steps: a pure function of seed, step and place in the global batch; validation: of the batch.

Nothing has to be saved to resume exactly, and a sample draws the same noise on any rank.
"""

import hashlib
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

__all__ = ["batch_generator", "normal_like", "sample_generators", "uniform"]

_STREAM = 0x464C4F57  # apart from the streams that choose and augment samples


def sample_generators(seed: int, step: int, places: Sequence[int]) -> list[torch.Generator]:
    """One CPU generator for each sample, by its place in the global batch of a step."""
    generators = []
    for place in places:
        word = np.random.SeedSequence([seed, _STREAM, step, place]).generate_state(1, np.uint64)[0]
        generators.append(torch.Generator().manual_seed(int(word >> np.uint64(1))))
    return generators


def batch_generator(ids: Sequence[str]) -> torch.Generator:
    """Of a validation batch, from the ids of its samples: always the same, whatever was measured before."""
    digest = hashlib.blake2b("\n".join(ids).encode(), digest_size=4).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest))


def normal_like(
    values: Float[torch.Tensor, " batch *rest"], generators: Sequence[torch.Generator]
) -> Float[torch.Tensor, " batch *rest"]:
    """Standard normal noise, sample by sample; drawn on the CPU, so any device gets the same."""
    noise = [torch.randn(values.shape[1:], generator=generator) for generator in generators]
    return torch.stack(noise).to(values.device, values.dtype)


def uniform(
    generators: Sequence[torch.Generator], device: torch.device | str = "cpu"
) -> Float[torch.Tensor, " batch"]:
    """One number in [0, 1) for each sample."""
    return torch.cat([torch.rand(1, generator=generator) for generator in generators]).to(device)
