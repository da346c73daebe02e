"""A clip that a training never saw."""

from dataclasses import replace

from model.data.config import Cameras
from model.data.index import open_motions
from model.recipes.stage_one_config import StageOneTrainingConfig

__all__ = ["held_out_clip"]


def held_out_clip(config: StageOneTrainingConfig) -> str:
    """`DATASET#CLIP_ID` of the first clip that the configuration validates on, in its first dataset.

    A held-out camera of a training motion, or any camera of another split. Raises ModelError, ShardError.
    """
    data, split = config.data, config.validation.split
    cameras: Cameras = "held_out" if split == data.split else "all"
    stream = config.stage_one.recipe.stream(data, surface=False)
    index = open_motions(
        replace(stream, datasets=data.datasets[:1], split=split, cameras=cameras, views=(1, 1))
    )
    motion = index.motions[0]
    clip_ids = index.shards[motion.shard].read_clips(("clip_id",))["clip_id"]
    return f"{data.datasets[0]}#{clip_ids[motion.clip_rows[0]]}"
