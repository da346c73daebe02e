"""Threads share the samples of a step: the same gradient as in one piece, the same bits every time, no thread left."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import nn

from model.data.batch import Batch
from model.training.sample_threads import SampleThreads, shares_of
from model.training.step_generators import normal_like, sample_generators
from model.training.task import Losses
from tests.benchmarks.bench_model import random_batch

CPU = torch.device("cpu")


@dataclass(frozen=True, kw_only=True)
class Noisy:
    """A network on noised images; one of its weights is used twice, one is not used at all."""

    net: nn.Sequential
    unused: nn.Parameter

    @property
    def parameters(self) -> list[nn.Parameter]:
        return [*self.net.parameters(), self.unused]

    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        noised = batch.images + normal_like(batch.images, generators)
        features = self.net(self.net[0](noised.flatten(0, 1)).tanh())
        per_sample = features.square().unflatten(0, noised.shape[:2]).mean(dim=(1, 2, 3, 4))
        return Losses(total=per_sample.mean(), parts={"largest": per_sample.detach().mean()})


@pytest.fixture
def task() -> Noisy:
    torch.manual_seed(0)
    net = nn.Sequential(nn.Conv2d(3, 3, 3, padding=1), nn.Conv2d(3, 4, 3))
    return Noisy(net=net, unused=nn.Parameter(torch.ones(2)))


@pytest.fixture
def batch() -> Batch:
    torch.manual_seed(1)
    return random_batch(2, 16, samples=6)


def gradients(
    task: Noisy, batch: Batch, threads: int, *, bfloat16: bool = False, steps: int = 1
) -> tuple[list[torch.Tensor | None], Losses]:
    for parameter in task.parameters:
        parameter.grad = None
    with SampleThreads(CPU, threads) as shared:
        losses = [
            shared.backward(
                task.loss,
                batch,
                sample_generators(0, step, range(6)),
                task.parameters,
                bfloat16=bfloat16,
                weight=1 / steps,
            )
            for step in range(steps)
        ]
    return [parameter.grad for parameter in task.parameters], losses[-1]


@pytest.mark.parametrize("threads", [2, 3, 4, 6, 9])
@pytest.mark.parametrize("steps", [1, 2])
def test_the_gradient_is_that_of_one_piece(task, batch, threads, steps):
    whole, whole_losses = gradients(task, batch, 1, steps=steps)
    shared, losses = gradients(task, batch, threads, steps=steps)
    assert shared[-1] is None
    for a, b in zip(whole[:-1], shared[:-1], strict=True):
        assert a is not None
        assert b is not None
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(losses.total, whole_losses.total)
    torch.testing.assert_close(losses.parts, whole_losses.parts)
    assert not losses.total.requires_grad


@pytest.mark.parametrize("bfloat16", [False, True])
def test_no_thread_is_faster_than_the_result(task, batch, bfloat16):
    """Twenty races, one outcome."""
    first, _ = gradients(task, batch, 3, bfloat16=bfloat16)
    for _ in range(20):
        again, _ = gradients(task, batch, 3, bfloat16=bfloat16)
        for a, b in zip(first[:-1], again[:-1], strict=True):
            assert a is not None
            assert b is not None
            assert torch.equal(a, b)


def test_shares_are_equal_and_no_more_than_threads():
    assert [shares_of(6, threads) for threads in (1, 2, 3, 4, 5, 6, 7)] == [1, 2, 3, 3, 3, 6, 6]
    assert [shares_of(samples, 4) for samples in (1, 2, 4, 5, 7, 8)] == [1, 2, 4, 1, 1, 4]


def test_the_caller_keeps_its_threads_and_none_is_left(task, batch):
    own, alive = torch.get_num_threads(), threading.active_count()
    torch.set_num_threads(2)
    try:
        gradients(task, batch, 3)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(own)
    assert threading.active_count() == alive


def test_each_thread_has_its_part_of_the_cores(task, batch):
    counted: list[int] = []

    def loss(part: Batch, generators: Sequence[torch.Generator]) -> Losses:
        counted.append(torch.get_num_threads())
        return task.loss(part, generators)

    with SampleThreads(CPU, 4) as shared:
        for samples in (6, 2):
            some = batch.part(0, samples)
            shared.backward(
                loss,
                some,
                sample_generators(0, 0, range(samples)),
                task.parameters,
                bfloat16=False,
                weight=1.0,
            )
    assert counted == [1, 1, 1, 2, 2]


def test_an_error_in_a_thread_is_the_step_s(task, batch):
    bad = replace(
        batch,
        ids=tuple("abcdef"),
        images=batch.images.where(torch.arange(6).reshape(6, 1, 1, 1, 1) < 4, np.nan),
    )

    def loss(part: Batch, generators: Sequence[torch.Generator]) -> Losses:
        if bool(part.images.isnan().any()):
            raise ArithmeticError(f"NaN in {part.ids}")
        return task.loss(part, generators)

    with SampleThreads(CPU, 3) as shared, pytest.raises(ArithmeticError, match=r"NaN in \('e', 'f'\)"):
        shared.backward(
            loss, bad, sample_generators(0, 0, range(6)), task.parameters, bfloat16=False, weight=1.0
        )
