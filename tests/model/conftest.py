"""What PyTorch draws without a generator is the same for every test; one training of both stages serves all tests."""

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from tests.model.data.balls import write_balls
from tests.model.inference.small_networks import fill_some, small_stage_one, small_stage_two, train_small


@pytest.fixture(autouse=True, scope="module")
def _seeded_module() -> None:
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def _seeded(_seeded_module: None) -> None:
    torch.manual_seed(0)


@dataclass(frozen=True, kw_only=True)
class Runs:
    """What the tests start from. Do not change it."""

    dataset: Path
    one: Path
    two: Path


@pytest.fixture(scope="session")
def runs(tmp_path_factory) -> Runs:
    root = tmp_path_factory.mktemp("runs")
    dataset = write_balls(root / "balls", splits=[["train", "train"]], n_frames=4)
    runs = Runs(
        dataset=dataset,
        one=train_small(root / "one", small_stage_one(dataset)),
        two=train_small(root / "two", small_stage_two(dataset)),
    )
    fill_some(runs.one)
    return runs
