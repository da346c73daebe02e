"""The plan is a pure function of the configuration and deals objects out evenly."""

from collections import Counter
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.plan.plan import Candidate, Plan, PlanConfig, PlanError, make_plan, read_plan, write_plan
from shards.splits import SplitRule, split_of_object

UIDS = [f"starter/object-{i}" for i in range(7)]
RULE = SplitRule(val_fraction=0.2, test_fraction=0.3)


def plan_of(motions: int, per_shard: int, *, seed: int = 0, uids: list[str] = UIDS) -> Plan:
    return make_plan(
        PlanConfig(motions=motions, motions_per_shard=per_shard),
        dataset_seed=seed,
        candidates=[
            Candidate(object_uid=uid, sequence_id="", licence="CC0-1.0", appearance="original")
            for uid in uids
        ],
        left_probability=0.0,
        split_rule=RULE,
        n_cameras=4,
        n_frames=12,
        image_size=(256, 256),
        samples=16,
    )


@given(motions=st.integers(1, 60), per_shard=st.integers(1, 9), seed=st.integers(0, 2**31))
def test_every_motion_is_in_exactly_one_shard_and_objects_come_in_rounds(motions, per_shard, seed):
    plan = plan_of(motions, per_shard, seed=seed)
    indices = [m.motion_index for shard in range(plan.n_shards) for m in plan.shard(shard)]
    assert indices == list(range(motions))
    assert max(len(plan.shard(shard)) for shard in range(plan.n_shards)) <= per_shard
    uses = Counter(m.object_uid for m in plan.motions)
    assert max(uses.values()) - min(uses[uid] for uid in UIDS) <= 1
    assert all(m.split == split_of_object(m.object_uid, RULE) for m in plan.motions)


def test_plan_does_not_depend_on_the_order_of_the_library():
    assert plan_of(20, 3) == plan_of(20, 3, uids=UIDS[::-1])


def test_first_motions_stay_when_more_are_planned():
    assert plan_of(40, 5).motions[:20] == plan_of(20, 5).motions


def test_another_seed_gives_another_order():
    assert plan_of(20, 3) != plan_of(20, 3, seed=1)


def test_round_trip(tmp_path):
    plan = plan_of(11, 2)
    write_plan(plan, tmp_path / "plan.parquet")
    assert read_plan(tmp_path / "plan.parquet") == plan
    changed = Plan(motions=(replace(plan.motions[0], split="other"), *plan.motions[1:]))
    assert changed != plan


@pytest.mark.parametrize("shard", [-1, 4, 1000])
def test_shard_outside_the_plan_names_the_range(shard):
    with pytest.raises(PlanError, match=rf"shard {shard} is outside the plan: expected 0\.\.3"):
        plan_of(8, 2).shard(shard)


def test_damaged_or_missing_plan_is_one_clear_error(tmp_path):
    path = tmp_path / "plan.parquet"
    with pytest.raises(PlanError, match="no plan here"):
        read_plan(path)
    write_plan(plan_of(8, 2), path)
    data = bytearray(path.read_bytes())
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(PlanError, match="not a readable plan"):
        read_plan(path)


def test_an_empty_selection_is_refused():
    with pytest.raises(PlanError, match="nothing to plan"):
        plan_of(8, 2, uids=[])
