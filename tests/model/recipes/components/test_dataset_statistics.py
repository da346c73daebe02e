"""What a run knows of its training data: measured once, read back exactly, one line when broken."""

import pytest
import torch

from model.errors import ModelError
from model.recipes.components.dataset_statistics import DatasetStatistics, load_statistics, statistics_of_run


def test_measured_once_and_read_back(tmp_path):
    shape = torch.rand(64, 64, 64, generator=torch.Generator().manual_seed(0)) < 0.1
    first = statistics_of_run(tmp_path, lambda: DatasetStatistics(latent_scale=1.0 / 3.0, mean_shape=shape))
    assert [path.name for path in tmp_path.iterdir()] == ["dataset_statistics.safetensors"]
    (tmp_path / "checkpoints" / "step-00000001").mkdir(parents=True)
    again = statistics_of_run(tmp_path, lambda: pytest.fail("measured again"))
    for statistics in (first, again, load_statistics(tmp_path)):
        assert statistics.latent_scale == 1.0 / 3.0
        assert torch.equal(statistics.mean_shape, shape)


def test_those_of_a_run_without_a_checkpoint_are_measured_again(tmp_path):
    """They may be of other data: nothing but a checkpoint knows which."""
    shape = torch.zeros(64, 64, 64, dtype=torch.bool)
    statistics_of_run(tmp_path, lambda: DatasetStatistics(latent_scale=1.0, mean_shape=shape))
    again = statistics_of_run(tmp_path, lambda: DatasetStatistics(latent_scale=2.0, mean_shape=~shape))
    for statistics in (again, load_statistics(tmp_path)):
        assert statistics.latent_scale == 2.0
        assert statistics.mean_shape.all()


@pytest.mark.parametrize("content", [None, b"", b"not a file of tensors"])
def test_missing_or_broken_is_one_line(tmp_path, content):
    if content is not None:
        (tmp_path / "dataset_statistics.safetensors").write_bytes(content)
    with pytest.raises(ModelError, match="cannot be read") as caught:
        load_statistics(tmp_path)
    assert "\n" not in str(caught.value)
