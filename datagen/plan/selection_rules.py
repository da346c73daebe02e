"""Which motions are worth drawing: licence, takedown, texture quality, degree of object movement.

The paper selects by texture quality and object movement without giving thresholds; here every
threshold is a setting and every decision is recorded with its metrics (`selection.parquet`).
Rules apply in the order of `Rule`; the first one that a motion breaks removes it.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

from datagen.grasps.object_movement import measure_movement
from datagen.grasps.recorded.graspxl import LICENCE, SequenceFile, read_sequence
from datagen.input_error import InputError
from datagen.objects.asset.mirror import unmirrored_uid
from datagen.objects.catalogue.description import ObjectDescription
from datagen.objects.catalogue.folder_layouts import drawn_uid
from datagen.objects.catalogue.licences import spdx_of
from datagen.objects.errors import ObjectError
from datagen.objects.mesh.mesh_measures import MeshMeasures
from datagen.objects.mesh.texture_quality import TextureQuality
from datagen.objects.stores.library import ObjectLibrary
from datagen.plan.plan import Candidate
from shards.settings import Range
from shards.splits import object_identity

__all__ = [
    "AnnotationRule",
    "Decision",
    "MovementRule",
    "Rule",
    "SelectionConfig",
    "TextureRule",
    "decide_object",
    "names_of",
    "normalised_name",
    "own_entries",
    "read_takedown",
    "removed_by_rule",
    "taken_down",
]

_OBJAVERSE_ID = re.compile(r"[0-9a-f]{32}$")
_NAN = float("nan")


class Rule(Enum):
    """Why a motion is removed; in the order in which the rules apply."""

    EXCLUDED = "excluded in the configuration"
    TAKEDOWN = "on the takedown list"
    UNUSABLE = "object cannot be used"
    LICENCE = "licence is not allowed"
    ANNOTATION = "annotation: texture, animation, age or size"
    TEXTURE = "texture quality"
    SAME_OBJECT = "same object as another"
    SEQUENCE = "recorded motion cannot be used"
    MOVEMENT = "degree of object movement"


@dataclass(frozen=True, kw_only=True)
class AnnotationRule:
    """Pre-filter by a store's own metrics, before a mesh is read; objects without annotation pass."""

    min_textures: Annotated[int, Range(0, 1000)]
    max_faces: Annotated[int, Range(1, 1_000_000_000)]
    allow_animated: bool
    allow_age_restricted: bool


@dataclass(frozen=True, kw_only=True)
class TextureRule:
    """Texture quality, measured on the asset."""

    min_resolution_px: Annotated[int, Range(0, 65_536)]
    min_color_detail: Annotated[float, Range(0, 1)]  # 0..1


@dataclass(frozen=True, kw_only=True)
class MovementRule:
    """Degree of object movement, measured on a recorded motion; simulated ones have grasp.min_movement_rad."""

    min_rise_m: Annotated[float, Range(0, 10)]
    min_travel_m: Annotated[float, Range(0, 10)]
    min_rotation_rad: Annotated[float, Range(0, 100)]


@dataclass(frozen=True, kw_only=True)
class SelectionConfig:
    """Thresholds of every rule."""

    # An object that cannot be used: remove it and tell the reason, or stop there.
    unusable: Literal["stop", "remove"]
    licence_allow: tuple[str, ...]  # short names (cc0, by, by-nc) or SPDX ids
    takedown: (
        Path | None
    )  # text file: one object uid or sequence id a line, # comments; null: only the project's
    annotation: AnnotationRule
    texture: TextureRule
    movement: MovementRule

    def __post_init__(self) -> None:
        for name in self.licence_allow:
            spdx_of(name)


@dataclass(frozen=True, kw_only=True)
class Decision:
    """One row of selection.parquet. Metrics are NaN (or empty) where a rule before them decided."""

    object_uid: str
    sequence_id: str  # empty: simulated
    kept: bool
    rule: str  # that removed it; empty when kept
    reason: str  # with metrics
    licence: str
    appearance: str  # original or generated
    texture_resolution_px: float
    color_detail: float
    rise_m: float
    travel_m: float
    rotation_range_rad: float
    # Of the drawn surface (`Fingerprint`), and what its reader guessed or left out; empty where nothing was read.
    shape: tuple[float, ...]
    size_m: float
    color: tuple[float, ...]
    notes: tuple[str, ...]

    @property
    def candidate(self) -> Candidate:
        return Candidate(
            object_uid=self.object_uid,
            sequence_id=self.sequence_id,
            licence=self.licence,
            appearance=self.appearance,
        )


def read_takedown(path: Path | None) -> frozenset[str]:
    """Names on the project's own takedown list and on a user's.

    InputError when the user's file is missing: never an empty list instead.
    """
    ours = (files("datagen.objects") / "data" / "takedown.txt").read_text(encoding="utf-8")
    return _entries(ours) | own_entries(path)


def own_entries(path: Path | None) -> frozenset[str]:
    """Names on a user's list. InputError when the file is missing."""
    if path is None:
        return frozenset()
    try:
        return _entries(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            path,
            f"cannot be read ({error})",
            expected="the takedown list of selection.takedown, a text file",
            action="Correct the path, or set selection.takedown to null.",
        ) from error


def _entries(text: str) -> frozenset[str]:
    entries = (line.partition("#")[0].strip() for line in text.splitlines())
    return frozenset(normalised_name(entry) for entry in entries if entry)


def taken_down(uid: str, sequence_id: str, takedown: frozenset[str]) -> str | None:
    """The entry of a takedown list that names this motion, or None."""
    named = takedown & (names_of(uid) | {sequence_id})
    return min(named) if named else None


def names_of(uid: str) -> frozenset[str]:
    """What an object may be called in a list: its uid at this size, itself, or its bare Objaverse id."""
    unmirrored = unmirrored_uid(uid)
    drawn = drawn_uid(unmirrored)
    if drawn != unmirrored:  # named for what it is, not for what shares its split
        return names_of(drawn) | {unmirrored}
    identity = object_identity(unmirrored)
    bare = identity.rpartition("/")[2]
    return frozenset({unmirrored, identity} | ({bare} if _OBJAVERSE_ID.fullmatch(bare) else set()))


def normalised_name(entry: str) -> str:
    """An entry as `names_of` and sequence ids spell it: of a link to a model its id, no mirror images."""
    at_end = _OBJAVERSE_ID.search(entry.lower().rstrip("/"))
    if "://" in entry and at_end is not None:
        return at_end[0]
    found = unmirrored_uid(entry)
    return found.lower() if _OBJAVERSE_ID.fullmatch(found.lower()) else found


def decide_object(
    uid: str,
    sequences: Sequence[SequenceFile],
    library: ObjectLibrary,
    config: SelectionConfig,
    *,
    excluded: frozenset[str],
    takedown: frozenset[str],
) -> list[Decision]:
    """Decisions on all motions of one object; `sequences` is empty when motions are simulated.

    What cannot be read is removed by a rule of its own, with the reader's message as reason; with
    `unusable: stop` the ObjectError itself is raised.
    """
    ids = [file.sequence_id for file in sequences] or [""]
    described = _Described(licence="", appearance="", measures=None)
    removed = _by_name(uid, excluded, takedown)
    if removed is None:
        try:
            removed, described = _by_object(library, uid, config)
        except ObjectError as error:
            if config.unusable == "stop":
                raise
            removed = Rule.UNUSABLE, str(error)
    if removed is not None or not sequences:
        return [_decision(uid, sequence_id, removed, described) for sequence_id in ids]
    return [_recorded(file, uid, described, config, takedown) for file in sequences]


def removed_by_rule(decisions: Sequence[Decision]) -> dict[Rule, tuple[int, int]]:
    """(motions, objects) that each rule removed, rules in order, zeros included."""
    motions = Counter(decision.rule for decision in decisions)
    objects = Counter(rule for rule, _ in {(d.rule, d.object_uid) for d in decisions})
    return {rule: (motions[rule.value], objects[rule.value]) for rule in Rule}


Removed = tuple[Rule, str] | None


@dataclass(frozen=True, kw_only=True)
class _Described:
    """What is known of an object when a decision falls."""

    licence: str
    appearance: str
    measures: MeshMeasures | None


def _by_name(uid: str, excluded: frozenset[str], takedown: frozenset[str]) -> Removed:
    if names_of(uid) & excluded:
        return Rule.EXCLUDED, "named in objects.exclude"
    entry = taken_down(uid, "", takedown)
    return None if entry is None else (Rule.TAKEDOWN, f"listed as {entry}")


def _by_object(library: ObjectLibrary, uid: str, config: SelectionConfig) -> tuple[Removed, _Described]:
    """Licence and annotation first: they cost nothing; the texture is measured only of what passes."""
    description = library.describe(uid)
    known = _Described(licence=description.licence, appearance=description.appearance, measures=None)
    removed = _by_licence(description.licences, description.licence, config)
    if removed is not None:
        return removed, known
    removed = _by_annotation(description, config.annotation)
    if removed is not None:
        return removed, known
    measures = library.measure(uid)
    return _by_texture(measures.texture, config.texture), replace(known, measures=measures)


def _by_licence(licences: Sequence[str], name: str, config: SelectionConfig) -> Removed:
    """Every part of a licence must be allowed."""
    allowed = {spdx_of(allow) for allow in config.licence_allow}
    return (
        None if set(licences) <= allowed else (Rule.LICENCE, f"{name}; allowed: {', '.join(sorted(allowed))}")
    )


def _by_annotation(described: ObjectDescription, rule: AnnotationRule) -> Removed:
    noted = described.annotation
    if noted is None:
        return None
    checks = (
        (described.appearance == "original" and noted.texture_count is not None
         and noted.texture_count < rule.min_textures,
         f"{noted.texture_count} textures, at least {rule.min_textures} wanted"),
        (noted.face_count is not None and noted.face_count > rule.max_faces,
         f"{noted.face_count} faces, at most {rule.max_faces} wanted"),
        (bool(noted.animation_count) and not rule.allow_animated, f"{noted.animation_count} animations"),
        (bool(noted.age_restricted) and not rule.allow_age_restricted, "age restricted"),
    )  # fmt: skip
    return next(((Rule.ANNOTATION, reason) for broken, reason in checks if broken), None)


def _by_texture(texture: TextureQuality, rule: TextureRule) -> Removed:
    if texture.texture_resolution_px < rule.min_resolution_px:
        return Rule.TEXTURE, f"{texture.texture_resolution_px} px of texture, {rule.min_resolution_px} wanted"
    if texture.color_detail < rule.min_color_detail:
        return Rule.TEXTURE, f"colour detail {texture.color_detail:.3f}, {rule.min_color_detail} wanted"
    return None


def _recorded(
    file: SequenceFile,
    uid: str,
    described: _Described,
    config: SelectionConfig,
    takedown: frozenset[str],
) -> Decision:
    rule = config.movement
    motion_licence = _by_licence([LICENCE], f"of the recorded motion: {LICENCE}", config)
    if motion_licence is not None:
        return _decision(uid, file.sequence_id, motion_licence, described)
    if file.sequence_id in takedown:
        return _decision(uid, file.sequence_id, (Rule.TAKEDOWN, f"listed as {file.sequence_id}"), described)
    try:
        T_world_from_file = read_sequence(file).T_world_from_file
    except InputError as error:
        return _decision(uid, file.sequence_id, (Rule.SEQUENCE, str(error)), described)
    moved = measure_movement(T_world_from_file)
    rise_m = float(T_world_from_file[-1, 2, 3] - T_world_from_file[0, 2, 3])
    checks = (
        (rise_m, rule.min_rise_m, "rises {:.3f} m, {} wanted"),
        (moved.travel_m, rule.min_travel_m, "travels {:.3f} m, {} wanted"),
        (moved.rotation_range_rad, rule.min_rotation_rad, "turns {:.3f} rad, {} wanted"),
    )
    removed = next(
        ((Rule.MOVEMENT, text.format(found, least)) for found, least, text in checks if found < least), None
    )
    metrics = (rise_m, moved.travel_m, moved.rotation_range_rad)
    return _decision(uid, file.sequence_id, removed, described, metrics)


def _decision(
    uid: str,
    sequence_id: str,
    removed: Removed,
    described: _Described,
    movement: tuple[float, float, float] = (_NAN, _NAN, _NAN),
) -> Decision:
    measures = described.measures
    texture = None if measures is None else measures.texture
    fingerprint = None if measures is None else measures.fingerprint
    return Decision(
        object_uid=uid,
        sequence_id=sequence_id,
        kept=removed is None,
        rule="" if removed is None else removed[0].value,
        reason="" if removed is None else removed[1],
        licence=described.licence,
        appearance=described.appearance,
        texture_resolution_px=_NAN if texture is None else float(texture.texture_resolution_px),
        color_detail=_NAN if texture is None else texture.color_detail,
        rise_m=movement[0],
        travel_m=movement[1],
        rotation_range_rad=movement[2],
        shape=() if fingerprint is None else fingerprint.shape,
        size_m=_NAN if fingerprint is None else fingerprint.size_m,
        color=() if fingerprint is None else fingerprint.color,
        notes=() if measures is None else measures.notes,
    )
