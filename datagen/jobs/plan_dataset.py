"""What a dataset will hold, decided once: dataset.json, selection.parquet, plan.parquet."""

from collections.abc import Callable
from pathlib import Path

from datagen.config import DatasetConfig, config_as_yaml, provenance_of
from datagen.jobs.select_motions import Selection, select_motions
from datagen.plan.plan import PLAN_FILE, Plan, make_plan, read_plan, write_plan
from shards.schema import CONVENTIONS, SCHEMA_VERSION
from shards.storage.records import DatasetRecord
from shards.writer import begin_dataset

__all__ = ["plan_dataset"]


def plan_dataset(
    config: DatasetConfig,
    out: Path,
    *,
    workers: int = 1,
    report: Callable[[int, int], None] | None = None,
) -> tuple[Plan, Selection | None]:
    """The plan of `out`: the one that is there, or one that is made now (then with its selection).

    A plan is made once. Shards of one dataset may be rendered on many machines at different times,
    so what comes into a store later changes nothing; a worker refuses what differs from the plan.
    `workers` and `report` are those of `select_motions`. ShardError when `out` holds a dataset of
    another configuration.
    """
    record = DatasetRecord(
        schema_version=SCHEMA_VERSION,
        name=config.name,
        conventions=CONVENTIONS,
        provenance=provenance_of(config),
        config_yaml=config_as_yaml(config),
        split_rule=config.split,
    )
    path = out / PLAN_FILE
    if (out / "dataset.json").exists():
        begin_dataset(out, record)
    if path.exists():
        return read_plan(path), None
    selection = select_motions(config, out, workers=workers, report=report)
    plan = make_plan(
        config.plan,
        dataset_seed=config.seed,
        candidates=[decision.candidate for decision in selection.kept],
        left_probability=config.hand.left_probability,
        split_rule=config.split,
        n_cameras=config.sampling.cameras.n_cameras,
        n_frames=config.sampling.clip.n_frames,
        image_size=config.sampling.cameras.image_size,
        samples=config.sampling.render.samples,
    )
    begin_dataset(out, record)  # only now: a selection that fails leaves the folder free
    write_plan(plan, path)
    return plan, selection
