"""One small dataset, made once; tests that damage it work on a copy."""

import shutil
from pathlib import Path

import pytest

from tests.shards.synthetic import synthetic_dataset


@pytest.fixture(scope="session")
def dataset_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two motions, two cameras, three frames; do not change it."""
    return synthetic_dataset(tmp_path_factory.mktemp("dataset") / "two-balls")


@pytest.fixture
def dataset_copy(dataset_dir: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    return Path(shutil.copytree(dataset_dir, tmp_path / "copy"))
