"""The split of an object is a property of its uid and the rule."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shards.splits import SplitRule, split_of_object

RULE = SplitRule(val_fraction=0.1, test_fraction=0.1)


def test_known_objects_stay_where_they_are():
    """Pinned: a change here would move objects of published sets between splits."""
    uids = ("mug-1", "bottle-3", "ball-0", "objaverse/000-023/4f2ae", "größe", "")
    assert [split_of_object(uid, RULE) for uid in uids] == [
        "train",
        "test",
        "train",
        "train",
        "train",
        "train",
    ]


def test_fractions_are_met():
    splits = [split_of_object(f"object-{i}", RULE) for i in range(20_000)]
    assert splits.count("test") / len(splits) == pytest.approx(0.1, abs=0.01)
    assert splits.count("val") / len(splits) == pytest.approx(0.1, abs=0.01)


@given(st.text(), st.floats(0, 0.4), st.floats(0, 0.4))
def test_a_larger_validation_set_takes_from_training_only(uid, test_fraction, val_fraction):
    small = SplitRule(val_fraction=val_fraction, test_fraction=test_fraction)
    large = SplitRule(val_fraction=val_fraction + 0.2, test_fraction=test_fraction)
    before, after = split_of_object(uid, small), split_of_object(uid, large)
    assert before == after or (before, after) == ("train", "val")


@pytest.mark.parametrize(("val_fraction", "test_fraction"), [(-0.1, 0.1), (0.6, 0.5)])
def test_impossible_fractions_are_refused(val_fraction, test_fraction):
    with pytest.raises(ValueError, match="split fractions"):
        SplitRule(val_fraction=val_fraction, test_fraction=test_fraction)
