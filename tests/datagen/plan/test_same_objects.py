"""What is one object is drawn once, its variants fall into its split, and what has published names stays."""

from dataclasses import replace

import numpy as np

from datagen.plan.same_objects import SAME_SHAPE, join_same_objects, said_of_same_objects
from datagen.plan.selection_rules import Decision, Rule, names_of
from shards.splits import SplitRule, object_identity, split_of_object

CUBE, BALL = (0.5, 0.6, 0.7), (0.9, 0.2, 0.1)
GREY, RED, BLUE = (0.6, 0.6, 0.6), (0.8, 0.1, 0.1), (0.1, 0.1, 0.8)


def decision(uid: str, shape=CUBE, *, size_m=0.05, color=GREY, texture_px=0.0, sequence_id="") -> Decision:
    return Decision(
        object_uid=uid,
        sequence_id=sequence_id,
        kept=True,
        rule="",
        reason="",
        licence="CC0-1.0",
        appearance="original",
        texture_resolution_px=texture_px,
        color_detail=0.0,
        rise_m=float("nan"),
        travel_m=float("nan"),
        rotation_range_rad=float("nan"),
        shape=shape,
        size_m=size_m,
        color=color,
        notes=(),
    )


def test_the_best_of_several_files_is_drawn():
    decisions = [
        decision("folder/a_scan"),
        decision("folder/b_textured", color=RED, texture_px=512.0),
        decision("folder/c_millimetres", size_m=50.0),
        decision("folder/d_ball", BALL),
        decision("folder/e_low", color=(0.82, 0.12, 0.1), texture_px=64.0),
    ]
    joined, lines = join_same_objects(decisions)
    assert [one.object_uid for one in joined if one.kept] == ["folder/b_textured", "folder/d_ball"]
    removed = [one for one in joined if not one.kept]
    assert {one.rule for one in removed} == {Rule.SAME_OBJECT.value}
    assert all("folder/b_textured" in one.reason for one in removed)
    (line,) = lines
    assert line.startswith("one object by its surface: folder/b_textured is drawn, not folder/a_scan, ")


def test_other_sizes_and_colors_of_one_shape_are_drawn_in_one_split():
    decisions = [
        decision("folder/big", size_m=0.08),
        decision("folder/blue", color=BLUE),
        decision("folder/grey"),
        decision("folder/red", color=RED),
    ]
    joined, lines = join_same_objects(decisions)
    kept = [one.object_uid for one in joined if one.kept]
    # The grey one is a copy of the first coloured one of its size.
    assert kept == ["folder/big", "folder/big@folder%2Fblue", "folder/big@folder%2Fred"]
    rule = SplitRule(val_fraction=0.3, test_fraction=0.3)
    assert len({split_of_object(uid, rule) for uid in kept}) == 1
    assert {object_identity(uid) for uid in kept} == {"folder/big"}
    assert len(lines) == 2
    assert (
        lines[1] == "one shape in other sizes or colours: folder/blue, folder/red in the split of folder/big"
    )


def test_lists_name_a_variant_by_what_it_is():
    assert names_of("folder/big@folder%2Fred") == {"folder/big@folder%2Fred", "folder/red"}
    assert "folder/big" in names_of("folder/big@mirrored")


def test_what_was_removed_or_not_read_joins_nothing():
    removed = replace(decision("folder/b"), kept=False, rule=Rule.LICENCE.value)
    unread = replace(decision("folder/c"), shape=())
    damaged = replace(decision("folder/d"), shape=(float("nan"),) * 3)
    decisions = [decision("folder/a"), removed, unread, damaged]
    joined, lines = join_same_objects(decisions)
    np.testing.assert_equal([vars(one) for one in joined], [vars(one) for one in decisions])
    assert lines == ()
    assert join_same_objects([]) == ([], ())


def test_the_threshold_counts_each_number():
    near = tuple(number + 0.9 * SAME_SHAPE for number in CUBE)
    far = (CUBE[0] + 1.1 * SAME_SHAPE, *CUBE[1:])
    joined, _ = join_same_objects([decision("folder/a"), decision("folder/b", near)])
    assert [one.kept for one in joined] == [True, False]
    joined, _ = join_same_objects([decision("folder/a"), decision("folder/b", far)])
    assert [one.kept for one in joined] == [True, True]


def test_published_objects_keep_their_names_and_it_is_said():
    sizes = [decision("objaverse/x@large"), decision("objaverse/x@small", size_m=0.03)]
    assert said_of_same_objects(sizes, SplitRule(val_fraction=0.1, test_fraction=0.1)) == ()
    uids = [f"objaverse/{k}" for k in range(40)]
    rule = SplitRule(val_fraction=0.3, test_fraction=0.3)
    (line,) = said_of_same_objects([decision(uid) for uid in uids], rule)
    assert line.startswith("the same shape: objaverse/0, objaverse/1, ")
    assert line.endswith("in the splits test and train and val")
