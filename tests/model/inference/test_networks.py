"""A run is opened as what it is."""

import pytest

from model.errors import ModelError
from model.inference.networks import open_stage_one


def test_a_checkpoint_of_the_other_stage_is_one_line(runs, tmp_path):
    (tmp_path / "stage_one").symlink_to(runs.two / "slat_flow")
    with pytest.raises(
        ModelError, match="with a configuration of the other stage; expected a training of stage 1"
    ):
        open_stage_one(tmp_path)
