"""The verifier accepts what is right and names what is not, one invariant at a time."""

import dataclasses
import hashlib
import shutil

import numpy as np
import pytest

from shards.reader import open_shard
from shards.splits import split_of_object
from shards.storage.images import (
    MASK_BITS,
    Masks,
    decode_geometry,
    decode_masks,
    encode_geometry,
    encode_masks,
    encode_rgb_png,
)
from shards.verify import verify_dataset, verify_shard
from shards.writer import begin_dataset, commit_shard, shard_dir, stage_motion
from tests.shards.synthetic import (
    PROVENANCE,
    SPLIT_RULE,
    dataset_record,
    synthetic_clip,
    synthetic_object,
)


def test_a_good_dataset_has_no_findings(dataset_dir):
    steps = []
    (report,) = verify_dataset(dataset_dir)
    assert report.ok
    assert report.findings == ()
    assert (report.n_objects, report.n_clips, report.n_frames) == (2, 4, 12)
    verify_shard(
        open_shard(shard_dir(dataset_dir, 0)),
        split_rule=SPLIT_RULE,
        progress=lambda done, total: steps.append((done, total)),
    )
    assert steps == [(i, 4) for i in range(5)]


def findings(root, *, objects=None, clips=None, frames=None) -> str:
    """What the verifier says of a motion changed by these functions."""
    object_row = synthetic_object(0)
    clip, frame_rows = synthetic_clip(object_row, 0, 0, 2, 40)
    object_row = dataclasses.replace(object_row, **(objects(object_row) if objects else {}))
    clip = dataclasses.replace(clip, **(clips(clip) if clips else {}))
    frame_rows = [dataclasses.replace(f, **(frames(f) if frames else {})) for f in frame_rows]
    stage_motion(
        root,
        0,
        0,
        object_row=object_row,
        clips=[clip],
        frames=frame_rows,
        timings_s={},
        provenance=PROVENANCE,
    )
    commit_shard(root, 0, motion_indices=[0], provenance=PROVENANCE)
    report = verify_shard(open_shard(shard_dir(root, 0)), split_rule=SPLIT_RULE)
    assert report.ok == (not report.findings)
    return "\n".join(map(str, report.findings))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda row: {"licence": ""}, "no licence"),
        (lambda row: {"mesh_sha256": "0" * 64}, "mesh_glb does not match mesh_sha256"),
        (lambda row: {"object_scale_m": 1.0}, "T_objmesh_from_canonical is not object_scale_m"),
        (lambda row: {"surface_points": 1.1 * row.surface_points}, "surface points outside"),
        (lambda row: {"surface_normals": 2 * row.surface_normals}, "surface normals are not unit"),
        (lambda row: {"occupancy_64": row.occupancy_64[:0]}, "occupancy_64 is empty"),
        (lambda row: {"occupancy_64": row.occupancy_64 + np.uint8(10)}, "occupancy_64 outside 0..63"),
        (lambda row: {"occupancy_64": row.occupancy_64[::-1]}, "occupancy_64 is not sorted"),
        (
            lambda row: {"occupancy_64": row.occupancy_64[: len(row.occupancy_64) // 2]},
            "occupancy_64 does not cover",
        ),
        (lambda row: {"sdf_values": -row.sdf_values}, "occupancy_64 and sdf_values disagree"),
    ],
)
def test_objects(tmp_path, change, problem):
    assert f"object ball-0: {problem}" in findings(tmp_path, objects=change)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda row: {"split": other_split(row.split)}, "split: the rule says"),
        (lambda row: {"K": row.K + 99 * np.eye(3, k=2)}, "principal point outside the image"),
        (lambda row: {"K": row.K + np.eye(3, k=1) * [[1], [0], [0]]}, "without skew"),
        (lambda row: {"fps": 30.0}, "time_s is not frame_index / fps"),
        (lambda row: {"object_visible_fraction_min": 0.123}, "object_visible_fraction_min is not"),
        (lambda row: {"has_table": True}, "has_table and table_top_z_m disagree"),
        (lambda row: {"rgb_codec": "jpeg"}, "rgb is not jpeg (frames 0, 1)"),
        (lambda row: {"image_width": 41}, "images of sizes"),
        (lambda row: {"min_margin_px": 19.0}, "px of the border, min_margin_px says 19.00"),
    ],
)
def test_clips(tmp_path, change, problem):
    assert problem in findings(tmp_path, clips=change)


def other_split(split: str) -> str:
    return "test" if split == "train" else "train"


def changed_masks(row, **masks):
    current = {name: getattr(decode_masks(row.masks), name) for name in MASK_BITS}
    changed = Masks(**current | {name: change(current) for name, change in masks.items()})
    return encode_masks(
        np.sum([np.uint8(b) * getattr(changed, n) for n, b in MASK_BITS.items()], 0, np.uint8)
    )


def changed_geometry(row, **change):
    geometry = dataclasses.replace(decode_geometry(row.geometry), **change)
    return encode_geometry(geometry.depth, geometry.depth_object, geometry.normals_cam, compression="zip")


def scaled(row, name, factor=1.01):
    return changed_geometry(row, **{name: getattr(decode_geometry(row.geometry), name) * np.float32(factor)})


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            lambda row: {"masks": changed_masks(row, hand_amodal=lambda m: m["hand_amodal"] & False)},
            "visible hand outside its amodal mask",
        ),
        (
            lambda row: {
                "masks": changed_masks(row, arm_visible=lambda m: m["hand_visible"] | m["arm_visible"])
            },
            "visible masks overlap",
        ),
        (
            lambda row: {"masks": changed_masks(row, object_amodal=lambda m: m["object_amodal"] | True)},
            "object.Z and the amodal object mask disagree",
        ),
        (lambda row: {"object_pixels_amodal": 3}, "object_pixels_amodal is not the mask's"),
        (
            lambda row: {"hand_box_visible_px": np.array([0, 0, 1, 1])},
            "hand_box_visible_px is not the mask's",
        ),
        (lambda row: {"hand_visible_fraction": 0.5}, "hand_visible_fraction is not the masks'"),
        (
            lambda row: {"geometry": changed_geometry(row, depth=np.zeros((40, 40), np.float32))},
            "no depth where",
        ),
        (lambda row: {"geometry": scaled(row, "depth")}, "Z lies behind object.Z"),
        (
            lambda row: {"geometry": scaled(row, "depth_object")},
            "Z and object.Z differ where the object is visible",
        ),
        (
            lambda row: {"geometry": scaled(row, "normals_cam")},
            "normals are not unit",
        ),
        (lambda row: {"geometry": b"broken"}, "damaged OpenEXR image"),
        (lambda row: {"rgb": row.rgb[:-5]}, "truncated PNG"),
        (lambda row: {"rgb": encode_rgb_png(np.zeros((8, 8, 3), np.uint8))}, "images of sizes"),
        (lambda row: {"joints_px": row.joints_px + 0.02}, "joints_px are not the projection"),
        (lambda row: {"joints_px": row.joints_px * np.nan}, "joints_px are not the projection"),
        (lambda row: {"T_world_from_obj": np.diag([1.0, 1.0, -1.0, 1.0])}, "T_world_from_obj is not rigid"),
        (lambda row: {"T_world_from_obj": np.diag([2.0, 2.0, 2.0, 1.0])}, "T_world_from_obj is not rigid"),
    ],
)
def test_frames(tmp_path, change, problem):
    text = findings(tmp_path, frames=change)
    assert problem in text
    assert "frames 0, 1" in text


def test_small_numerical_noise_is_no_finding(tmp_path):
    assert findings(tmp_path, frames=lambda row: {"joints_px": row.joints_px + 0.005}) == ""


def stage_two_splits(root, split_rule):
    """Shard 0 and shard 1 with the same object, in another split the second time."""
    begin_dataset(root, dataclasses.replace(dataset_record(), split_rule=split_rule))
    for shard in (0, 1):
        object_row = synthetic_object(0)
        clip, frames = synthetic_clip(object_row, shard, 0, 2, 40)
        split = clip.split if shard == 0 else other_split(clip.split)
        stage_motion(
            root, shard, shard, object_row=object_row, clips=[dataclasses.replace(clip, split=split)],
            frames=frames, timings_s={}, provenance=PROVENANCE,
        )  # fmt: skip
        commit_shard(root, shard, motion_indices=[shard], provenance=PROVENANCE)


def test_an_object_in_two_splits_is_found_over_all_shards(tmp_path):
    stage_two_splits(tmp_path, SPLIT_RULE)
    first, second = verify_dataset(tmp_path)
    assert first.ok
    truth = split_of_object("ball-0", SPLIT_RULE)
    text = "\n".join(map(str, second.findings))
    assert f"split: the rule says {truth}" in text
    assert f"object 'ball-0' is in split {other_split(truth)} here and in {truth} in" in text


def test_a_shard_of_a_dataset_is_held_against_its_rule_and_a_lone_one_is_not(tmp_path):
    stage_two_splits(tmp_path / "set", SPLIT_RULE)
    (in_place,) = verify_dataset(shard_dir(tmp_path / "set", 1))
    assert "split: the rule says" in str(in_place.findings)
    shutil.copytree(shard_dir(tmp_path / "set", 1), tmp_path / "alone")
    (alone,) = verify_dataset(tmp_path / "alone")
    assert alone.ok


def test_progress_names_the_shard(dataset_dir):
    steps = []
    list(verify_dataset(dataset_dir, progress=lambda *step: steps.append(step)))
    assert steps == [(0, i, 4) for i in range(5)]


def test_a_damaged_file_is_found_once_and_by_name(dataset_copy):
    path = dataset_copy / "shards/shard-00000/frames.parquet"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    (report,) = verify_dataset(dataset_copy)
    (finding,) = report.findings
    assert "frames.parquet: the content does not match its SHA-256" in str(finding)
    assert hashlib.sha256(data).hexdigest() != open_shard(path.parent).record.files["frames.parquet"].sha256
