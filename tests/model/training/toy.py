"""The smallest real training: a linear map learns to find the mean colour; rows depend on their place alone.

Also a program, for tests over several processes: `python toy.py FOLDER STEPS GLOBAL_BATCH [FAULT]`.
"""

import sys
import time
from collections.abc import Generator, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator
from torch import nn

from model.data.batch import Batch
from model.training.config import OptimizerConfig, TrainerConfig
from model.training.step_generators import normal_like
from model.training.task import Losses, Measurements
from model.training.trainer import PlacedBatch, StepReport, TrainingEvent, train

EPOCH = 12  # samples
OPTIMIZER = OptimizerConfig(
    learning_rate=0.01, betas=(0.9, 0.999), weight_decay=0.0, warmup_steps=3, final_factor=0.1, clip_norm=1.0
)


def settings(steps: int, **changes: object) -> TrainerConfig:
    values: dict = {
        "seed": 3,
        "steps": steps,
        "accumulate": 1,
        "precision": "float32",
        "ema_decay": 0.9,
        "checkpoint_every": 4,
        "keep_checkpoints": 2,
        "validate_every": 1000,
        "log_every": 1,
    }
    return TrainerConfig(**values | changes)


def sample(position: int, *, poison: bool = False) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(position)
    images = torch.from_numpy(rng.random((2, 3, 4, 4), dtype=np.float32))
    if poison:
        images[0, 0, 0, 0] = float("nan")
    return {
        "images": images,
        "object_amodal": torch.zeros(2, 4, 4, dtype=torch.bool),
        "object_visible": torch.zeros(2, 4, 4, dtype=torch.bool),
        "hand_visible": torch.zeros(2, 4, 4, dtype=torch.bool),
        "K": torch.eye(3).repeat(2, 1, 1),
        "T_cam_from_canonical": torch.eye(4).repeat(2, 1, 1),
        "occupancy": torch.zeros(64, 64, 64, dtype=torch.bool),
        "joints_px": torch.zeros(2, 21, 2),
        "is_right": torch.tensor(True),
    }


class ToySource:
    """Epochs of EPOCH samples in natural order; each rank takes its part of every global batch."""

    def __init__(
        self,
        global_batch: int,
        *,
        rank: int = 0,
        ranks: int = 1,
        poison: int | None = None,
        data_sha256: str = "colours",
    ) -> None:
        self.global_batch, self.rank, self.ranks, self.poison = global_batch, rank, ranks, poison
        self.data_sha256 = data_sha256
        self.seen: list[int] = []

    def batches(self, epoch: int, samples_consumed: int) -> Generator[PlacedBatch, None, None]:
        while True:
            if samples_consumed >= EPOCH:
                epoch, samples_consumed = epoch + 1, 0
            places = range(self.rank, self.global_batch, self.ranks)
            positions = [EPOCH * epoch + samples_consumed + place for place in places]
            self.seen += positions
            rows = [sample(position, poison=position == self.poison) for position in positions]
            samples_consumed += self.global_batch
            stacked: dict[str, Any] = {name: torch.stack([row[name] for row in rows]) for name in rows[0]}
            yield PlacedBatch(
                batch=Batch(
                    **stacked,
                    ids=tuple(f"toy:{epoch}:{position}" for position in positions),
                    views=tuple(
                        (f"clip-{position} frame 0", f"clip-{position} frame 7") for position in positions
                    ),
                ),
                places=list(places),
                epoch=epoch,
                samples_consumed=samples_consumed,
            )


class ToyTask:
    def __init__(self) -> None:
        torch.manual_seed(0)
        self.net = nn.Sequential(nn.Flatten(), nn.Linear(96, 8), nn.GELU(), nn.Linear(8, 3))
        self.net.register_buffer("calls", torch.zeros(1))

    @property
    def module(self) -> nn.Module:
        return self.net

    def loss(self, batch: Batch, generators: Sequence[torch.Generator]) -> Losses:
        self.net.get_buffer("calls").add_(1)
        noise = normal_like(batch.images, generators)
        predicted = self.net(batch.images + 0.1 * noise)
        error = (predicted - batch.images.mean(dim=(1, 3, 4))).square().mean()
        return Losses(total=error, parts={"color": error})

    def measure(self, batches: Iterable[Batch]) -> Measurements:
        errors = [self.loss(batch, [torch.Generator() for _ in batch.ids]).total for batch in batches]
        return Measurements(
            numbers={"error": [float(error) for error in errors]},
            images={"grey": np.zeros((4, 4, 3), np.uint8)},
        )


def main(folder: str, steps: str, global_batch: str, fault: str = "") -> None:
    accelerator = Accelerator(cpu=True)
    source = ToySource(int(global_batch), rank=accelerator.process_index, ranks=accelerator.num_processes)
    task = ToyTask()

    def slow(event: TrainingEvent) -> None:
        if isinstance(event, StepReport):
            print(event.step, flush=True)
            time.sleep(0.2 if fault == "slow" else 0.0)

    train(
        task,
        source,
        settings(int(steps)),
        OPTIMIZER,
        folder=Path(folder),
        config_yaml="toy",
        config_sha256="toy",
        report=slow,
        accelerator=accelerator,
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
