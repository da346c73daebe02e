"""Scene files: exact round trips, content hashes, and refusal of damaged files."""

import contextlib
import dataclasses

import numpy as np
import pytest

from datagen.scene.scene import Scene
from datagen.scene.scene_file import SceneFileError, load_scene, save_scene, scene_sha256
from tests.datagen.scene.boxes import made_box_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    return made_box_scene()


def assert_same(a, b):
    assert type(a) is type(b)
    if dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for left, right in zip(a, b):
            assert_same(left, right)
    elif isinstance(a, np.ndarray):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        np.testing.assert_array_equal(a, b)
    else:
        assert a == b


def test_a_scene_comes_back_as_it_was(scene, tmp_path):
    for table in (scene.table, None):
        original = dataclasses.replace(scene, table=table)
        save_scene(original, tmp_path / "scene.npz")
        loaded = load_scene(tmp_path / "scene.npz")
        assert_same(original, loaded)
        assert scene_sha256(loaded) == scene_sha256(original)
    assert list(tmp_path.iterdir()) == [tmp_path / "scene.npz"]


def test_the_hash_sees_every_part(scene):
    hashes = {scene_sha256(scene)}
    moved = scene.hand_verts_world.copy()
    moved[0, 0, 0] = np.nextafter(moved[0, 0, 0], 1.0)
    look = dataclasses.replace(scene.hand_look, skin_png=scene.hand_look.skin_png + b"\0")
    for changed in (
        dataclasses.replace(scene, seed=scene.seed + 1),
        dataclasses.replace(scene, hand_verts_world=moved),
        dataclasses.replace(scene, hand_look=look),
        dataclasses.replace(scene, table=None),
        dataclasses.replace(scene, cameras=scene.cameras[::-1]),
    ):
        hashes.add(scene_sha256(changed))
    assert len(hashes) == 6


def test_no_byte_can_change_unnoticed(scene, tmp_path):
    path = tmp_path / "scene.npz"
    save_scene(scene, path)
    whole = path.read_bytes()
    for position in np.random.default_rng(0).integers(0, len(whole), 60):
        damaged = bytearray(whole)
        damaged[position] ^= 0x10
        path.write_bytes(bytes(damaged))
        with contextlib.suppress(SceneFileError):
            assert_same(load_scene(path), scene)  # a byte of no meaning, such as a time stamp
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SceneFileError, match="write it again"):
        load_scene(path)


def test_a_file_of_another_version_says_so(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("datagen.scene.scene_file.SCENE_FILE_VERSION", 99)
    save_scene(scene, tmp_path / "scene.npz")
    monkeypatch.undo()
    with pytest.raises(SceneFileError, match="version 99"):
        load_scene(tmp_path / "scene.npz")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SceneFileError, match="no such scene file"):
        load_scene(tmp_path / "absent.npz")
