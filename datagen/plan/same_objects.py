"""Objects that are one object: found by their surfaces, whatever the files are called.

The distance of two fingerprints is the largest difference of their numbers. What decides the threshold:
DECISIONS D112.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from datagen.objects.catalogue.folder_layouts import variant_of
from datagen.plan.selection_rules import Decision, Rule
from shards.splits import SplitRule, object_identity, split_of_object

__all__ = ["SAME_SHAPE", "join_same_objects", "said_of_same_objects", "same_shapes"]

# Largest difference of two fingerprints of one shape; a side of a cube 1.6 % longer makes as much.
SAME_SHAPE = 0.005
_SAME_SIZE = 0.03  # relative
_SAME_COLOR = 0.08  # of the means, sRGB
_COLORLESS = 0.02  # spread of the channels of a grey surface
_UNITS = (1.0, 2.54, 10.0, 25.4, 100.0, 1000.0)  # by which a size may differ that was read in another unit


def same_shapes(
    shapes: Float[np.ndarray, "object number"], others: Float[np.ndarray, "other number"]
) -> list[tuple[int, int]]:
    """Pairs (of `shapes`, of `others`) that are equal within SAME_SHAPE, sorted."""
    tree = cKDTree(others)
    near = tree.query_ball_point(shapes, SAME_SHAPE, p=np.inf, return_sorted=True)
    return [(one, int(other)) for one, found in enumerate(near) for other in found]


def join_same_objects(decisions: Sequence[Decision]) -> tuple[list[Decision], tuple[str, ...]]:
    """Decisions on the objects of a folder, where equal surfaces become one object, and a line on each of these.

    Of files that agree also in size (or differ by a unit) and in colour (or have none) the one with the
    best texture is kept and the others are removed. What differs in size or colour alone is kept as
    a variant (`variant_of`) of the first by uid, and so falls into its split.
    """
    objects = _kept_objects(decisions)
    same_as: dict[str, str] = {}
    new_uid: dict[str, str] = {}
    lines: list[str] = []
    for group in _groups(objects):
        drawn: list[Decision] = []
        for one in sorted((objects[uid] for uid in group), key=_preference):
            twin = next((other for other in drawn if _is_copy(one, other)), None)
            if twin is None:
                drawn.append(one)
            else:
                same_as[one.object_uid] = twin.object_uid
        identity, *variants = sorted(one.object_uid for one in drawn)
        new_uid |= {uid: variant_of(identity, uid) for uid in variants}
        lines += _lines(group, same_as, variants, identity)
    joined = [_joined(decision, same_as, new_uid) for decision in decisions]
    return joined, tuple(lines)


def said_of_same_objects(decisions: Sequence[Decision], split_rule: SplitRule) -> tuple[str, ...]:
    """A line on each set of objects with one surface but several identities, which stays as it is."""
    objects = _kept_objects(decisions)
    lines = []
    for group in _groups(objects):
        uids = sorted({object_identity(uid) for uid in group})
        if len(uids) > 1:
            splits = sorted({split_of_object(uid, split_rule) for uid in uids})
            where = f"in the splits {' and '.join(splits)}" if len(splits) > 1 else f"all in {splits[0]}"
            lines.append(f"the same shape: {', '.join(uids[:4])}{' ...' if len(uids) > 4 else ''}, {where}")
    return tuple(lines)


def _kept_objects(decisions: Sequence[Decision]) -> dict[str, Decision]:
    """One decision of each object that is kept and was measured."""
    objects: dict[str, Decision] = {}
    for decision in decisions:
        if decision.kept and decision.shape and np.isfinite(decision.shape).all():
            objects.setdefault(decision.object_uid, decision)
    return objects


def _groups(objects: Mapping[str, Decision]) -> list[list[str]]:
    """Uids of two or more objects of one shape; shapes that a chain of equal ones connects are equal."""
    uids = list(objects)
    if len(uids) < 2:
        return []
    shapes = np.array([objects[uid].shape for uid in uids])
    pairs = np.array(same_shapes(shapes, shapes))
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(uids), len(uids)))
    _, label = connected_components(graph, directed=False)
    groups: dict[int, list[str]] = {}
    for uid, number in zip(uids, label):
        groups.setdefault(int(number), []).append(uid)
    return [group for group in groups.values() if len(group) > 1]


def _preference(decision: Decision) -> tuple[bool, float, float, str]:
    """Sorts what is drawn to the front of its copies."""
    return (
        _is_colorless(decision),
        -decision.texture_resolution_px,
        -decision.color_detail,
        decision.object_uid,
    )


def _is_colorless(decision: Decision) -> bool:
    plain = decision.texture_resolution_px == 0 and decision.color_detail == 0
    return plain and float(np.ptp(decision.color)) < _COLORLESS


def _is_copy(one: Decision, other: Decision) -> bool:
    """Whether an object of the shape of `other` is that object in another file."""
    ratio = max(one.size_m, other.size_m) / min(one.size_m, other.size_m)
    if not any(abs(ratio / unit - 1.0) <= _SAME_SIZE for unit in _UNITS):
        return False
    return _is_colorless(one) or float(np.abs(np.subtract(one.color, other.color)).max()) <= _SAME_COLOR


def _joined(decision: Decision, same_as: Mapping[str, str], new_uid: Mapping[str, str]) -> Decision:
    uid = decision.object_uid
    if uid in same_as and decision.kept:
        twin = same_as[uid]
        reason = f"the same surface as {new_uid.get(twin, twin)}, which is drawn"
        return replace(decision, kept=False, rule=Rule.SAME_OBJECT.value, reason=reason)
    return replace(decision, object_uid=new_uid[uid]) if uid in new_uid else decision


def _lines(
    group: Sequence[str], same_as: Mapping[str, str], variants: Sequence[str], identity: str
) -> list[str]:
    copies: dict[str, list[str]] = {}
    for uid in group:
        if uid in same_as:
            copies.setdefault(same_as[uid], []).append(uid)
    lines = [
        f"one object by its surface: {drawn} is drawn, not {_some(uids)}" for drawn, uids in copies.items()
    ]
    if variants:
        lines.append(f"one shape in other sizes or colours: {_some(variants)} in the split of {identity}")
    return lines


def _some(uids: Sequence[str]) -> str:
    return ", ".join(uids[:3]) + (f" and {len(uids) - 3:,} more" if len(uids) > 3 else "")
