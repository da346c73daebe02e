"""What is measured on the training objects sees them as they are."""

from dataclasses import replace

from model.data import ShardStream
from model.training.part_run import one_pass
from tests.model.data.balls import VARIED, stream_config, write_balls


def test_one_pass_reads_each_training_motion_once_and_never_mirrored(tmp_path):
    always = replace(VARIED, flip_probability=1.0)
    varied = stream_config(write_balls(tmp_path / "balls"), augmentation=always, samples_per_motion=5)
    (batch,) = ShardStream(one_pass(varied, 8))
    assert len(batch.ids) == len({name.split(":")[0] for name in batch.ids}) == 3
    assert batch.is_right.all()
    (mirrored,) = ShardStream(replace(one_pass(varied, 8), augmentation=always))
    assert not mirrored.is_right.any()
