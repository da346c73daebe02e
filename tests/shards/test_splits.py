"""The split of an object is a property of its uid and the rule."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shards.errors import SplitError
from shards.splits import ObjectSplits, SplitRule, identity_and_variant, object_identity, split_of_object

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


@pytest.mark.parametrize(
    ("uid", "identity", "variant"),
    [
        ("mug", "mug", ""),
        ("store/mug@large-mirrored", "store/mug", "@large-mirrored"),
        ("batch@1/mug", "batch@1/mug", ""),
        ("batch@1/mug@large", "batch@1/mug", "@large"),
        ("mug@a@b", "mug", "@a@b"),
    ],
)
def test_a_variant_begins_at_the_first_at_sign_of_the_last_part(uid, identity, variant):
    assert identity_and_variant(uid) == (identity, variant)
    assert object_identity(uid) == identity


@given(st.text("ab/@", max_size=12))
def test_identity_and_variant_are_the_uid_and_variants_share_a_split(uid):
    identity, variant = identity_and_variant(uid)
    assert identity + variant == uid
    assert split_of_object(uid, RULE) == split_of_object(identity, RULE)


def test_one_object_in_two_splits_is_refused_with_both_places():
    splits = ObjectSplits()
    splits.add("store/mug@large", "train", where="shard A")
    splits.add("store/mug", "train", where="shard B")
    splits.add("store/mug2", "test", where="shard B")
    with pytest.raises(SplitError) as caught:
        splits.add("store/mug@small", "test", where="shard C")
    assert str(caught.value).startswith(
        "shard C: object 'store/mug' is in split test here and in train in shard A (expected each object in one split"
    )


def test_objects_of_different_folders_are_different_objects():
    """Folders may have an "@" in their name: it begins no variant."""
    splits = ObjectSplits()
    splits.add("batch@1/mug", "train", where="a")
    splits.add("batch@2/mug", "test", where="a")
    splits.add("batch@1/cup", "val", where="a")
