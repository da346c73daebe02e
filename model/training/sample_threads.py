"""Loss and gradient of a batch, its samples shared among threads that meet once a step.

PyTorch's own threads share every operation and meet after each one: small operations gain little from a second core,
and whoever waits for a core makes all others wait (DECISIONS D104). Samples are shared here as ranks share them, so a
loss has to be a mean over samples, to draw from their generators alone, and to change nothing that lasts.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Barrier
from types import TracebackType

import torch
from torch import Tensor, nn

from model.data.batch import Batch
from model.training.task import Losses

__all__ = ["SampleThreads", "shares_of"]

LossFunction = Callable[[Batch, Sequence[torch.Generator]], Losses]


@dataclass(frozen=True, kw_only=True)
class _Share:
    """What one thread found."""

    losses: Losses
    gradients: tuple[Tensor | None, ...]


def shares_of(samples: int, threads: int) -> int:
    """The most equal shares of `samples`, one thread each at least."""
    return max(shares for shares in range(1, min(samples, threads) + 1) if samples % shares == 0)


class SampleThreads:
    """Threads for the steps of one training; closed like a file.

    On a CPU a step takes `shares_of(samples, threads)` of them, each with its part of PyTorch's threads. One thread,
    and any other device, computes the batch as a whole in the calling thread. The number of threads decides the order
    of sums; which of them is faster decides nothing.
    """

    def __init__(self, device: torch.device, threads: int) -> None:
        """`threads`: how many cores a step may use on a CPU."""
        self._device = device
        self._threads = threads if device.type == "cpu" else 1
        self._pool: ThreadPoolExecutor | None = None
        self._shares = 1

    def __enter__(self) -> "SampleThreads":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def backward(
        self,
        loss: LossFunction,
        batch: Batch,
        generators: Sequence[torch.Generator],
        parameters: Sequence[nn.Parameter],
        *,
        bfloat16: bool,
        weight: float,
    ) -> Losses:
        """The mean losses of the batch, detached; `weight` times their gradient is added to that of `parameters`."""
        shares = shares_of(len(batch.ids), self._threads)
        if shares == 1:
            with torch.autocast(self._device.type, torch.bfloat16, enabled=bfloat16):
                whole = loss(batch, generators)
            (weight * whole.total).backward()
            return _mean([whole])

        def share(index: int) -> _Share:
            size = len(batch.ids) // shares
            rows = slice(index * size, (index + 1) * size)
            # Threads would share the cache of cast weights, and empty it for each other at any time.
            with torch.autocast(self._device.type, torch.bfloat16, enabled=bfloat16, cache_enabled=False):
                losses = loss(batch.part(rows.start, rows.stop), generators[rows])
            gradients = torch.autograd.grad(losses.total, parameters, allow_unused=True)
            return _Share(losses=losses, gradients=gradients)

        found = list(self._pool_of(shares).map(share, range(shares)))
        for index, parameter in enumerate(parameters):
            gradients = [gradient for each in found if (gradient := each.gradients[index]) is not None]
            if gradients:
                mean = torch.stack(gradients).sum(dim=0) * (weight / shares)
                parameter.grad = mean if parameter.grad is None else parameter.grad + mean
        return _mean([each.losses for each in found])

    def _pool_of(self, shares: int) -> ThreadPoolExecutor:
        """As many threads as shares, each with its part of the cores; the calling thread keeps its own number."""
        if self._pool is None or self._shares != shares:
            self._close()
            own, each = torch.get_num_threads(), max(self._threads // shares, 1)
            all_there = Barrier(shares)

            def begin(_: int) -> None:
                torch.set_num_threads(each)
                torch.get_num_threads()  # the first call of a thread takes over what was set last, by anyone
                all_there.wait()

            self._pool, self._shares = ThreadPoolExecutor(shares, thread_name_prefix="samples"), shares
            list(self._pool.map(begin, range(shares)))
            torch.set_num_threads(own)  # each has set its own number, but also that of threads to come
        return self._pool

    def _close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None


def _mean(losses: Sequence[Losses]) -> Losses:
    """Of equal shares."""

    def mean(values: Sequence[Tensor]) -> Tensor:
        return torch.stack([value.detach() for value in values]).mean(dim=0)

    return Losses(
        total=mean([each.total for each in losses]),
        parts={name: mean([each.parts[name] for each in losses]) for name in losses[0].parts},
    )
