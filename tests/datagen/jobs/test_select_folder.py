"""A folder that a user hands in, from its files to what `datagen select` and `datagen plan` say."""

import os
import signal
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh
import yaml
from click.testing import CliRunner

from datagen.cli.main import main
from datagen.config import load_config
from datagen.input_error import InputError
from datagen.inspection.selection_table import selection_lines
from datagen.jobs import select_motions as module
from datagen.jobs.plan_dataset import plan_dataset
from datagen.jobs.planned_motion import load_object
from datagen.jobs.select_motions import select_motions
from datagen.objects.formats import reading
from datagen.plan.plan import SELECTION_FILE
from shards.splits import object_identity


@pytest.fixture
def meshes(tmp_path) -> Path:
    """One wedge as GLB, STL in millimetres and red PLY of another size, a ball and a broken file."""
    folder = tmp_path / "meshes"
    folder.mkdir()
    wedge = trimesh.Trimesh(
        [[0.0, 0.0, 0.0], [0.09, 0.0, 0.0], [0.0, 0.05, 0.0], [0.02, 0.03, 0.12]],
        [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
    )
    wedge.export(folder / "a_wedge.glb")
    copy = wedge.copy()
    copy.apply_scale(1000.0)
    copy.export(folder / "scan0001.stl")
    red = wedge.copy()
    red.apply_scale(1.5)
    red.visual.vertex_colors = [200, 0, 0, 255]
    red.export(folder / "red.ply")
    trimesh.creation.icosphere(3, 0.04).export(folder / "ball.obj")
    (folder / "[broken].glb").write_bytes(b"no model")
    return folder


@pytest.fixture
def config_file(meshes, tmp_path) -> Path:
    path = tmp_path / "config.yaml"
    config = {
        "extends": "tiny",
        "objects": {"source": "folder", "path": str(meshes), "cache_dir": str(tmp_path / "cache")},
        "selection": {"licence_allow": ["NOASSERTION"]},
    }
    path.write_text(yaml.safe_dump(config))
    return path


def test_one_object_in_several_files_is_drawn_once_and_said(config_file, tmp_path):
    selection = select_motions(load_config(config_file), tmp_path / "out")
    kept = [decision.object_uid for decision in selection.kept]
    assert sorted(kept) == ["folder/a_wedge", "folder/a_wedge@folder%2Fred", "folder/ball"]
    lines = selection_lines(selection)
    assert any(
        line == "one object by its surface: folder/a_wedge is drawn, not folder/scan0001" for line in lines
    )
    assert any("folder/red in the split of folder/a_wedge" in line for line in lines)
    assert any(line.startswith("cannot be used: folder/[broken]: ") for line in lines)
    again = select_motions(load_config(config_file), tmp_path / "out")
    assert selection_lines(again) == lines
    np.testing.assert_equal([vars(d) for d in again.decisions], [vars(d) for d in selection.decisions])


def test_variants_are_planned_into_one_split_and_load(config_file, tmp_path):
    config = load_config(config_file)
    plan, _ = plan_dataset(config, tmp_path / "out")
    assert {object_identity(motion.object_uid) for motion in plan.motions} == {
        "folder/a_wedge",
        "folder/ball",
    }
    splits: dict[str, set[str]] = {object_identity(motion.object_uid): set() for motion in plan.motions}
    for motion in plan.motions:
        splits[object_identity(motion.object_uid)].add(motion.split)
    assert all(len(found) == 1 for found in splits.values())
    (red,) = (motion for motion in plan.motions if "red" in motion.object_uid)
    asset = load_object(config, red)
    assert asset.uid == "folder/a_wedge@folder%2Fred"
    assert np.ptp(asset.mesh.verts_obj, axis=0).max() == pytest.approx(0.18)


def test_the_command_says_it_without_a_traceback(config_file, tmp_path):
    arguments = ["--config", str(config_file), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main, ["select", *arguments])
    assert result.exit_code == 0, result.output
    assert "same object as another" in result.output
    assert "cannot be used: folder/[broken]: " in result.output


def test_notes_of_readings_come_once_a_kind(config_file, meshes, tmp_path, monkeypatch):
    """With a reader that notes something of every file."""
    real = reading.object_mesh

    def noting(*args, **kwargs):
        read = real(*args, **kwargs)
        return reading.ReadObject(
            mesh=read.mesh,
            T_obj_from_file=read.T_obj_from_file,
            unit=read.unit,
            notes=(f"longest side {np.ptp(read.mesh.verts_obj, axis=0).max():.3f} read as metres",),
        )

    monkeypatch.setattr(reading, "object_mesh", noting)
    lines = selection_lines(select_motions(load_config(config_file), tmp_path / "out"))
    (note,) = (line for line in lines if line.startswith("note: "))
    assert note.startswith("note: folder/a_wedge: longest side 0.120 read as metres")
    assert note.endswith("(and 3 like it)")


def test_a_dataset_beside_it_with_the_same_objects_is_named(config_file, meshes, tmp_path):
    select_motions(load_config(config_file), tmp_path / "data" / "first")
    (meshes / "a_wedge.glb").rename(meshes / "other_name.glb")
    second = select_motions(load_config(config_file), tmp_path / "data" / "second")
    (line,) = (note for note in second.notes if note.startswith("first beside it"))
    assert "has 1 of these shapes under another name" in line
    assert "folder/a_wedge for folder/other_name" in line
    # One that is damaged says nothing and stops nothing.
    (tmp_path / "data" / "first" / SELECTION_FILE).write_bytes(b"PAR1")
    (tmp_path / "data" / "second" / SELECTION_FILE).unlink()
    third = select_motions(load_config(config_file), tmp_path / "data" / "second")
    assert not [note for note in third.notes if "beside" in note]


def test_fingerprints_are_kept_with_the_decisions(config_file, tmp_path):
    selection = select_motions(load_config(config_file), tmp_path / "out")
    rows = pq.read_table(tmp_path / "out" / SELECTION_FILE).to_pylist()
    assert [tuple(row["shape"]) for row in rows] == [decision.shape for decision in selection.decisions]
    assert {len(row["shape"]) for row in rows if row["kept"]} == {14}


def killed(config, takedown, tasks):
    """What the kernel does to a process for which there is no memory."""
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_worker_is_one_line(config_file, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_decide_all", killed)
    with pytest.raises(InputError, match=r"--workers 2: a process .* was killed.*with fewer workers"):
        select_motions(load_config(config_file), tmp_path / "out", workers=2)
    monkeypatch.undo()
    assert len(select_motions(load_config(config_file), tmp_path / "out", workers=2).kept) == 3


def test_an_error_comes_whole_out_of_a_worker(config_file, tmp_path):
    path = tmp_path / "stopping.yaml"
    path.write_text(f"extends: {config_file.name}\nselection: {{unusable: stop}}\n")
    with pytest.raises(InputError, match=r"\[broken\]\.glb"):
        select_motions(load_config(path), tmp_path / "out", workers=2)


def test_a_folder_that_is_not_set_is_refused(config_file, tmp_path):
    path = tmp_path / "unset.yaml"
    path.write_text(f"extends: {config_file.name}\nobjects: {{path: null}}\n")
    with pytest.raises(InputError, match=r"objects\.path: is not set"):
        select_motions(load_config(path), tmp_path / "out")
