"""A shard in the terminal: clips, objects, licences, quality, sizes, timings."""

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Group

from datagen.inspection.fitting_table import FittingTable, TableColumn
from shards.reader import ColumnTable, Shard
from shards.storage.records import ShardRecord
from shards.verify import ShardReport

__all__ = ["report_lines", "shard_line", "shard_summary", "short_uid"]

CLIP_COLUMNS = (
    "clip_id", "motion_index", "camera_kind", "object_uid", "split", "n_frames", "fps", "image_width",
    "image_height", "object_visible_fraction_mean", "object_visible_fraction_min", "object_drift_px",
    "min_margin_px", "max_penetration_m", "digits_in_contact", "slip_lift_m", "slip_manipulation_m",
    "grasp_attempts", "hand_model", "hand_side", "hand_stands_in_for", "grasp_source", "hdri",
    "table_material", "render_device", "render_samples", "render_seconds",
)  # fmt: skip
OBJECT_COLUMNS = (
    "object_uid",
    "licence",
    "author",
    "object_scale_m",
    "texture_resolution_px",
    "color_detail",
)

_AUTHOR_CHARACTERS = 24  # names may be long; the shard holds them whole


def shard_line(record: ShardRecord, out: Path) -> str:
    """One line on a finished shard."""
    size = sum(file.n_bytes for file in record.files.values()) / 1e6
    return (
        f"shard {record.shard} in {out}: {len(record.clip_ids)} clips, {record.files['frames.parquet'].rows} frames, "
        f"{size:.1f} MB, {len(record.skipped)} motions skipped"
    )


def report_lines(report: ShardReport) -> list[str]:
    """What `datagen verify` says of a shard: one line, and one for each finding."""
    state = "ok" if report.ok else f"{len(report.findings)} findings"
    counts = (
        f"{report.path}: {report.n_objects} objects, {report.n_clips} clips, {report.n_frames} frames, "
        f"{report.n_bytes / 1e6:.1f} MB, {len(report.skipped)} motions skipped: {state}"
    )
    return [counts, *(f"  {finding}" for finding in report.findings)]


def shard_summary(shard: Shard) -> Group:
    """Everything a person wants to know before using a shard, as rich tables."""
    clips = shard.read_clips(CLIP_COLUMNS)
    objects = shard.read_objects(OBJECT_COLUMNS)
    parts = [_overview(shard, clips), _objects(objects, clips), _motions(clips), _clips(clips)]
    parts += [_files(shard), _timings(shard)]
    if shard.record.skipped:
        parts.append(_skipped(shard))
    return Group(*parts)


def _text(name: str, rank: int = 0, *, folds: bool = False) -> TableColumn:
    return TableColumn(name=name, rank=rank, folds=folds)


def _number(name: str, rank: int = 0) -> TableColumn:
    return TableColumn(name=name, rank=rank, is_number=True)


def _overview(shard: Shard, clips: ColumnTable) -> FittingTable:
    record = shard.record
    sizes = sorted({f"{w} x {h}" for w, h in zip(clips["image_width"], clips["image_height"])})
    splits = Counter(clips["split"])
    table = FittingTable(f"shard {record.shard}: {shard.path}", [_text(""), _text("", folds=True)])
    for name, value in (
        ("schema version", record.schema_version),
        ("generator", record.provenance.generator_commit[:16]),
        ("configuration", record.provenance.config_sha256[:16]),
        ("motions", f"{len(record.motions) - len(record.skipped)} made, {len(record.skipped)} skipped"),
        ("clips", f"{len(clips)}"),
        ("frames", f"{sum(clips['n_frames'])}"),
        ("images", ", ".join(sizes)),
        ("motions from", ", ".join(sorted(set(clips["grasp_source"])))),
        ("hands", ", ".join(f"{hand} {count}" for hand, count in sorted(_hands(clips).items()))),
        ("splits", ", ".join(f"{split} {count}" for split, count in sorted(splits.items()))),
        ("rendered on", ", ".join(sorted(set(clips["render_device"])))),
    ):
        table.add_row(name, value)
    return table


def _objects(objects: ColumnTable, clips: ColumnTable) -> FittingTable:
    columns = [_text("object"), _text("licence", folds=True), _text("author", 3), _number("longest", 2)]
    columns += [_number("texture", 4), _number("detail", 5), _number("clips", 1)]
    table = FittingTable("objects", columns)
    count = Counter(clips["object_uid"])
    for i, uid in enumerate(objects["object_uid"]):
        table.add_row(
            uid,
            objects["licence"][i],
            objects["author"][i][:_AUTHOR_CHARACTERS],
            f"{100 * objects['object_scale_m'][i]:.1f} cm",
            f"{objects['texture_resolution_px'][i]} px",
            f"{objects['color_detail'][i]:.2f}",
            str(count[uid]),
        )
    return table


def _motions(clips: ColumnTable) -> FittingTable:
    """Grasp and setting of each motion; its clips share them."""
    columns = [
        _number("motion"),
        _text("object"),
        _text("hand", 3),
        _number("depth", 1),
        _number("digits", 2),
    ]
    columns += [_number("slip", 1), _number("tries", 6), _text("light", 5), _text("table", 4)]
    table = FittingTable("motions", columns, notes=["slip: in the lift / while turned"])
    for i in _first_clips(clips):
        table.add_row(
            str(clips["motion_index"][i]),
            short_uid(clips["object_uid"][i]),
            clips["hand_side"][i],
            _millimetres(float(clips["max_penetration_m"][i]), decimals=1),
            str(clips["digits_in_contact"][i]),
            _millimetres(float(clips["slip_lift_m"][i]), float(clips["slip_manipulation_m"][i])),
            str(clips["grasp_attempts"][i] or "-"),
            clips["hdri"][i],
            clips["table_material"][i] or "none",
        )
    return table


def short_uid(uid: str) -> str:
    """An uid with Objaverse's 32 digits cut to 8; others as they are."""
    return re.sub(r"[0-9a-f]{32}", lambda digits: f"{digits[0][:8]}…", uid)


def _hands(clips: ColumnTable) -> Counter[str]:
    """Clips per hand model, saying where it only stands in for the recorded one."""
    pairs = zip(clips["hand_model"], clips["hand_stands_in_for"])
    return Counter(f"{model} (stands in for {other})" if other else model for model, other in pairs)


def _millimetres(*lengths_m: float, decimals: int = 0) -> str:
    """Lengths with a slash between them, a dash for one that is not there."""
    shown = ("-" if np.isnan(length_m) else f"{1000 * length_m:.{decimals}f}" for length_m in lengths_m)
    return f"{'/'.join(shown)} mm"


def _clips(clips: ColumnTable) -> FittingTable:
    columns = [_text("clip"), _text("camera"), _number("fps", 5), _number("visible mean/min", 1)]
    columns += [_number("drift", 3), _number("margin", 2), _number("s/frame", 4)]
    table = FittingTable("clips", columns)
    for i, clip_id in enumerate(clips["clip_id"]):
        table.add_row(
            clip_id,
            clips["camera_kind"][i],
            f"{clips['fps'][i]:g}",
            f"{clips['object_visible_fraction_mean'][i]:.2f}/{clips['object_visible_fraction_min'][i]:.2f}",
            f"{clips['object_drift_px'][i]:.0f} px",
            f"{clips['min_margin_px'][i]:.0f} px",
            f"{clips['render_seconds'][i] / clips['n_frames'][i]:.2f}",
        )
    return table


def _first_clips(clips: ColumnTable) -> list[int]:
    return [int(i) for i in np.unique(clips["motion_index"], return_index=True)[1]]


def _files(shard: Shard) -> FittingTable:
    table = FittingTable("files", [_text("file"), _number("rows"), _number("size"), _text("sha256")])
    for name, file in sorted(shard.record.files.items()):
        table.add_row(name, str(file.rows), f"{file.n_bytes / 1e6:.2f} MB", file.sha256[:12])
    total = sum(file.n_bytes for file in shard.record.files.values())
    table.add_row("all", "", f"{total / 1e6:.2f} MB", "")
    return table


def _timings(shard: Shard) -> FittingTable:
    seconds: dict[str, list[float]] = defaultdict(list)
    for motion in shard.record.motions:
        for phase, value in motion.timings_s.items():
            seconds[phase].append(value)
    table = FittingTable("time", [_text("phase"), _number("all motions"), _number("median of a motion")])
    for phase, values in seconds.items():
        table.add_row(phase, f"{sum(values):.1f} s", f"{_median(values):.2f} s")
    return table


def _skipped(shard: Shard) -> FittingTable:
    table = FittingTable("skipped motions", [_number("motion"), _text("reason", folds=True)])
    for motion in shard.record.skipped:
        table.add_row(str(motion.motion_index), motion.skip_reason or "")
    return table


def _median(values: Sequence[float]) -> float:
    return float(np.median(np.asarray(values)))
