"""What PyTorch draws without a generator is the same for every test; one training of both stages serves all tests."""

import shutil
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
class StageOneRun:
    """A finished run of stage 1, its configuration and its data. Do not change them."""

    dataset: Path
    config: Path
    folder: Path


@dataclass(frozen=True, kw_only=True)
class Runs:
    """Both stages, ready to reconstruct. Do not change them."""

    dataset: Path
    one: Path
    two: Path


@pytest.fixture(scope="session")
def stage_one_run(tmp_path_factory) -> StageOneRun:
    root = tmp_path_factory.mktemp("stage_one")
    dataset = write_balls(root / "balls", splits=[["train", "train"]], n_frames=4)
    folder = train_small(root / "run", small_stage_one(dataset))
    return StageOneRun(dataset=dataset, config=folder.with_suffix(".yaml"), folder=folder)


@pytest.fixture(scope="session")
def runs(stage_one_run: StageOneRun, tmp_path_factory) -> Runs:
    root = tmp_path_factory.mktemp("runs")
    one = Path(shutil.copytree(stage_one_run.folder, root / "one"))
    fill_some(one)
    two = train_small(root / "two", small_stage_two(stage_one_run.dataset))
    return Runs(dataset=stage_one_run.dataset, one=one, two=two)
