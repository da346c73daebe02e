"""GraspXL's files: every layout, every number, every way in which a file can be wrong."""

import os
import pickle
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datagen.grasps.recorded.graspxl import find_sequences, read_sequence, sequence_file
from datagen.input_error import InputError
from shards.geometry import transform_points
from tests.datagen.grasps.recorded.graspxl_sample import SAMPLE, needs_sample
from tests.datagen.grasps.recorded.official_files import START, still_arrays, write_sequence

UID = "0123456789abcdef0123456789abcdef"
OTHER = "fedcba9876543210fedcba9876543210"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for part, size, uid, number in (
        ("mano_dataset_1", "large", UID, 1),
        ("mano_dataset_1", "large", UID, 10),
        ("mano_dataset_1", "large", UID, 2),
        ("mano_dataset_1", "small", OTHER, 1),
        ("mano_dataset_3", "medium", UID, 4),
    ):
        write_sequence(tmp_path, part, size, uid, number, still_arrays(uid))
    (tmp_path / "object_dataset").mkdir()
    return tmp_path


def ids(root: Path, **options: Any) -> list[str]:
    return [file.sequence_id for file in find_sequences(root, **options)]


def test_all_parts_and_sizes_are_found_in_natural_order(root):
    assert ids(root) == [
        f"mano_dataset_1/small/{OTHER}/mano_1",
        f"mano_dataset_1/large/{UID}/mano_1",
        f"mano_dataset_1/large/{UID}/mano_2",
        f"mano_dataset_1/large/{UID}/mano_10",
        f"mano_dataset_3/medium/{UID}/mano_4",
    ]
    assert ids(root, sizes=("medium",)) == [f"mano_dataset_3/medium/{UID}/mano_4"]
    assert find_sequences(root)[-1].object_uid == f"objaverse/{UID}@medium"


def test_dataset_example_a_single_part_and_nested_unzipping_are_the_same_data(root, tmp_path_factory):
    expected = ids(root)
    above = tmp_path_factory.mktemp("graspxl")
    shutil.copytree(root, above / "dataset_example")
    assert ids(above) == expected
    nested = tmp_path_factory.mktemp("nested")
    for part in ("mano_dataset_1", "mano_dataset_3"):
        shutil.copytree(root / part, nested / part / part)
    assert ids(nested) == expected
    assert ids(root / "mano_dataset_3") == expected[-1:]
    for folder in (root, above, nested):
        assert [sequence_file(folder, i) for i in expected] == list(find_sequences(folder))


@pytest.mark.parametrize("n_frames", [2, 80, 130, 155, 180])
def test_any_length_is_read_and_the_table_top_becomes_zero(tmp_path, n_frames):
    content = still_arrays(UID, n_frames)
    rng = np.random.default_rng(n_frames)
    content["right_hand"]["rot"][:] = rng.normal(size=(n_frames, 3))
    content[UID]["rot"][:] = rng.normal(size=(n_frames, 3))
    write_sequence(tmp_path, "mano_dataset_1", "large", UID, 1, content)
    motion = read_sequence(find_sequences(tmp_path)[0])
    assert len(motion.hand_pose) == n_frames
    points = rng.normal(size=(n_frames, 5, 3))
    turned = Rotation.from_rotvec(np.repeat(content[UID]["rot"], 5, axis=0)).apply(points.reshape(-1, 3))
    expected = turned.reshape(points.shape) + content[UID]["trans"][:, None] - START
    np.testing.assert_allclose(transform_points(motion.T_world_from_file, points), expected, atol=1e-6)
    np.testing.assert_allclose(
        motion.hand_translation_world, content["right_hand"]["trans"] - START, atol=1e-6
    )


def broken(change) -> dict:
    content = still_arrays(UID)
    change(content)
    return content


def _set(owner, key, value):
    return lambda content: content[owner].__setitem__(key, value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("right_hand"), rf"has the keys \['{UID}'\]; expected \['{UID}', 'right_hand'\]"),
        (lambda c: c.update({OTHER: c.pop(UID)}), rf"has the keys \['{OTHER}', 'right_hand'\]"),
        (lambda c: c["right_hand"].pop("pose"), r"lacks right_hand.pose \(found \['rot', 'trans'\]\)"),
        (_set("right_hand", "pose", np.zeros((155, 48), np.float32)), r"pose has shape \(155, 48\)"),
        (
            _set(UID, "rot", np.zeros((154, 3), np.float32)),
            r"\.rot has shape \(154, 3\); expected \(155, 3\)",
        ),
        (_set("right_hand", "rot", np.zeros((1, 3), np.float32)), "at least 2 frames"),
        (_set(UID, "trans", np.zeros((155, 3), np.int64)), "trans is int64"),
        (_set(UID, "trans", [[0.0] * 3] * 155), "trans is list"),
        (_set(UID, "trans", np.full((155, 3), np.nan, np.float32)), "not finite in frame 0"),
        (_set(UID, "trans", np.full((155, 3), 500.0, np.float32)), "object trans reaches"),
        (_set(UID, "angle", np.full((155, 1), 0.3, np.float32)), "an articulated object"),
    ],
)
def test_a_wrong_file_is_one_line_with_file_key_expected_and_found(tmp_path, change, message):
    path = write_sequence(tmp_path, "mano_dataset_1", "large", UID, 1, broken(change))
    with pytest.raises(InputError, match=message) as error:
        read_sequence(find_sequences(tmp_path)[0])
    assert str(path) in str(error.value)
    assert "expected" in str(error.value)
    assert "\n" not in str(error.value)


class _Hostile:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


def test_a_hostile_file_executes_nothing(tmp_path):
    marker = tmp_path / "executed"
    path = write_sequence(tmp_path, "mano_dataset_1", "large", UID, 1, {"right_hand": _Hostile(marker)})
    with pytest.raises(InputError, match=r"posix.*system|system"):
        read_sequence(find_sequences(tmp_path)[0])
    assert not marker.exists()
    np.load(path, allow_pickle=True)  # the attack is real: NumPy's own loader runs it
    assert marker.exists()


def test_a_plain_pickle_instead_of_npy_is_refused(tmp_path):
    path = write_sequence(tmp_path, "mano_dataset_1", "large", UID, 1, still_arrays(UID))
    path.write_bytes(pickle.dumps(still_arrays(UID)))
    with pytest.raises(InputError, match=r"mano_1\.npy"):
        read_sequence(find_sequences(tmp_path)[0])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p: p / "none", "is not a folder"),
        (lambda p: p, "holds no sequence of size small, medium, large .found: nothing"),
    ],
)
def test_a_wrong_folder_is_named(tmp_path, make, message):
    with pytest.raises(InputError, match=message):
        find_sequences(make(tmp_path))


def test_an_unknown_size_and_a_missing_sequence_are_named(root):
    with pytest.raises(InputError, match="has huge; expected small, medium, large"):
        find_sequences(root, ("huge",))
    with pytest.raises(InputError, match=r"mano_7\.npy: does not exist"):
        sequence_file(root, f"mano_dataset_1/large/{UID}/mano_7")


@needs_sample
def test_all_sequences_of_the_sample_are_read_and_lift_their_objects():
    files = find_sequences(SAMPLE)
    assert len(files) == 87
    motions = [read_sequence(file) for file in files]
    assert Counter(len(motion.hand_pose) for motion in motions) == {155: 85, 130: 1, 180: 1}
    for motion in motions:
        height = motion.T_world_from_file[:, 2, 3]
        assert height[-1] - height[0] > 0.1  # GraspXL's own rule of success
        assert np.abs(motion.T_world_from_file[0, :2, 3]).max() < 0.05  # starts in the middle of our world
