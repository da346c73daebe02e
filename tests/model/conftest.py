"""What PyTorch draws without a generator is the same for every test, in any order."""

import pytest
import torch


@pytest.fixture(autouse=True, scope="module")
def _seeded_module() -> None:
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def _seeded(_seeded_module: None) -> None:
    torch.manual_seed(0)
