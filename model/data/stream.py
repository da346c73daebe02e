"""ShardStream: from datasets, local or remote, to batches, in an order that can be resumed exactly.

    stream = ShardStream(config, rank=0, world_size=1, state=StreamState(epoch=0, consumed=0))
    for batch in stream:
        ...               # train on it
        stream.state      # what to store in a checkpoint: everything up to and including `batch`

Samples are decoded by loader processes started with "spawn" (fork is not safe with Arrow, fsspec and
OpenCV threads), a whole batch per process. State is kept where batches are handed out, so what was
prefetched but not used is read again after a resume.
"""

import contextlib
import os
import shutil
import signal
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, get_worker_info

from model.data.batch import OCCUPANCY_VOXELS, Batch, stack_samples
from model.data.config import StreamConfig, validation_config
from model.data.index import MotionIndex, open_motions
from model.data.order import SampleKey, StreamState, rank_batches
from model.data.reader import SampleReader
from model.errors import ModelError
from shards.errors import CorruptShardError, ShardError

__all__ = [
    "ShardStream",
    "StreamConfig",
    "StreamState",
    "open_motions",
    "validation_config",
]

_START = StreamState(epoch=0, consumed=0)
# 8,192 points, normals and colours, and 12,288 distances with their points, as datagen writes them; about.
_SURFACE_BYTES = 8192 * (2 * 12 + 12) + 12288 * 16


class ShardStream:
    """Batches of one rank. Iterating continues at `state`; closing ends the loader processes."""

    def __init__(
        self,
        config: StreamConfig,
        *,
        rank: int = 0,
        world_size: int = 1,
        state: StreamState = _START,
        index: MotionIndex | None = None,
    ) -> None:
        """`index` saves opening the datasets a second time. Raises ModelError, ShardError."""
        if not 0 <= rank < world_size:
            raise ModelError(
                "data", f"rank {rank} of {world_size}", expected="0 <= rank < world size", action=""
            )
        if config.endless and config.batch_size % world_size:
            raise ModelError(
                "recipe.batch_size",
                f"{config.batch_size} samples cannot be shared by {world_size} ranks",
                expected="a multiple of the number of ranks",
                action="batch_size counts the samples of all ranks together.",
            )
        self.config = config
        self.index = open_motions(config) if index is None else index
        self.state = state
        self.corrupt_rows: dict[str, None] = {}  # one line each, in the order they were met by this rank
        if state.consumed >= self.samples_per_epoch and config.endless:
            raise ModelError(
                "data state",
                f"{state.consumed} samples consumed of an epoch of {self.samples_per_epoch}",
                expected="the state of a run on the same data",
                action="Resume with the datasets of that run.",
            )
        self._rank, self._world_size = rank, world_size
        self._pending: deque[StreamState] = deque()
        self._loader: DataLoader | None = None

    @property
    def samples_per_epoch(self) -> int:
        """Over all ranks."""
        return len(self.index.motions) * self.config.samples_per_motion

    def __iter__(self) -> Iterator[Batch]:
        """Batches from `state` on; a stream that is not endless starts again when it is at its end."""
        if not self.config.endless and self.state.consumed >= self.samples_per_epoch:
            self.state = _START
        self._pending.clear()
        if self._loader is None:
            self._loader = self._make_loader()
        for delivery in self._loader:
            if delivery.error is not None:
                raise delivery.error
            self._count(delivery.faults)
            self.state = self._pending.popleft()
            if delivery.batch is not None:
                yield delivery.batch

    def close(self) -> None:
        """End the loader processes. The stream can be iterated again, which starts new ones."""
        self._loader = None

    def _keys(self) -> Iterator[tuple[SampleKey, ...]]:
        """What the loader asks for, ahead of what is handed out."""
        batches = rank_batches(
            self.state,
            n_motions=len(self.index.motions),
            samples_per_motion=self.config.samples_per_motion,
            batch_size=self.config.batch_size,
            views=self.config.views,
            seed=self.config.seed,
            rank=self._rank,
            world_size=self._world_size,
            endless=self.config.endless,
        )
        for keys, state in batches:
            self._pending.append(state)
            yield keys

    def _make_loader(self) -> DataLoader:
        workers = self.config.workers
        if workers:
            _check_shared_memory(self.config, self._world_size)
        return DataLoader(
            _Deliveries(self.index, self.config),
            batch_size=None,
            sampler=_Restartable(self),
            num_workers=workers,
            collate_fn=_unchanged,
            worker_init_fn=_start_worker if workers else None,
            multiprocessing_context="spawn" if workers else None,
            prefetch_factor=self.config.prefetch_batches if workers else None,
            persistent_workers=workers > 0,
        )

    def _count(self, faults: tuple[str, ...]) -> None:
        self.corrupt_rows.update(dict.fromkeys(faults))
        if len(self.corrupt_rows) > self.config.max_corrupt:
            raise CorruptShardError(
                f"{len(self.corrupt_rows)} corrupt rows, the last: {next(reversed(self.corrupt_rows))}",
                where=", ".join(self.config.datasets),
                expected=f"at most {self.config.max_corrupt} (data.max_corrupt)",
                fix="copy the damaged shards again",
            )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Delivery:
    """What a worker sends: a batch (None: an empty part), or the error that is to be raised."""

    batch: Batch | None
    faults: tuple[str, ...]
    error: ShardError | None


class _Deliveries(Dataset[_Delivery]):
    """Made in the main process, pickled to the workers; each opens its own reader."""

    def __init__(self, index: MotionIndex, config: StreamConfig) -> None:
        self._index, self._config = index, config
        self._reader: SampleReader | None = None

    def __getitem__(self, keys: tuple[SampleKey, ...]) -> _Delivery:
        if self._reader is None:
            self._reader = SampleReader(self._index, self._config)
        if not keys:
            return _Delivery(batch=None, faults=(), error=None)
        try:
            read = [self._reader.read(key) for key in keys]
        except ShardError as error:  # torch would raise it with a traceback as its message
            return _Delivery(batch=None, faults=(), error=error)
        ids = [f"{sample.motion_id}:{key.epoch}:{key.position}" for (sample, _), key in zip(read, keys)]
        batch = stack_samples([sample for sample, _ in read], ids, shared=get_worker_info() is not None)
        return _Delivery(batch=batch, faults=tuple(line for _, lines in read for line in lines), error=None)


class _Restartable:
    """A sampler that starts at the stream's state each time it is iterated."""

    def __init__(self, stream: ShardStream) -> None:
        self._stream = stream

    def __iter__(self) -> Iterator[tuple[SampleKey, ...]]:
        return self._stream._keys()


def _unchanged(delivery: Any) -> Any:
    return delivery


def _start_worker(_: int) -> None:
    cv2.setNumThreads(0)  # one thread per loader process, or they fight for the cores
    torch.set_num_threads(1)
    # glibc gives freed memory back above twice the largest block freed so far, and each sample would fault its pages in
    # anew; one large block (glibc's limit is 32 MB) keeps the memory of a batch with the process.
    np.empty(31 << 20, np.uint8)
    # Ctrl-C and the scheduler's SIGTERM reach the whole process group, and are the main process's to handle: it saves
    # and then ends its workers. Should it die, torch's watchdog ends them.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def _check_shared_memory(config: StreamConfig, world_size: int) -> None:
    """ModelError where prefetched batches cannot fit: Linux would kill the worker with a bus error."""
    if not os.path.isdir("/dev/shm"):
        return
    view = config.image_size**2 * (3 * 4 + 3)
    samples = -(-config.batch_size // world_size)
    surface = _SURFACE_BYTES if config.surface else 0
    needed = samples * (config.views[1] * view + OCCUPANCY_VOXELS**3 + surface)
    needed *= config.workers * config.prefetch_batches + 1
    free = 0
    with contextlib.suppress(OSError):
        free = shutil.disk_usage("/dev/shm").free
    if needed > free:
        raise ModelError(
            "/dev/shm",
            f"{free / 1e6:.0f} MB free, {needed / 1e6:.0f} MB needed for the batches that are prefetched",
            expected="room for workers x prefetch_batches batches",
            action="Lower data.workers or data.prefetch_batches, or give the container --shm-size.",
        )
