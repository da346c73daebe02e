"""What a run knows of its training data: measured once, read back exactly, one line when broken."""

import pytest
import torch

from model.errors import ModelError
from model.recipes.dataset_statistics import DatasetStatistics, load_statistics, statistics_of_run


def test_measured_once_and_read_back(tmp_path):
    shape = torch.rand(64, 64, 64, generator=torch.Generator().manual_seed(0)) < 0.1
    first = statistics_of_run(
        tmp_path / "run", lambda: DatasetStatistics(latent_scale=1.0 / 3.0, mean_shape=shape)
    )
    again = statistics_of_run(tmp_path / "run", lambda: pytest.fail("measured again"))
    for statistics in (first, again, load_statistics(tmp_path / "run")):
        assert statistics.latent_scale == 1.0 / 3.0
        assert torch.equal(statistics.mean_shape, shape)
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["dataset_statistics.safetensors"]


@pytest.mark.parametrize("content", [None, b"", b"not a file of tensors"])
def test_missing_or_broken_is_one_line(tmp_path, content):
    if content is not None:
        (tmp_path / "dataset_statistics.safetensors").write_bytes(content)
    with pytest.raises(ModelError, match="cannot be read") as caught:
        load_statistics(tmp_path)
    assert "\n" not in str(caught.value)
