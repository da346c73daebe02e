"""Folders of meshes: every object once, under one uid, with what its table tells; what is broken is named."""

import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

from datagen.objects.errors import ObjectError
from datagen.objects.stores.folder import MeshFolder, folder_state
from datagen.objects.stores.library import REFERENCE_READING, ObjectLibrary

GRASPXL = Path("/work/shared/graspxl_sample/object_dataset/large")


def test_folder_loads_notes_and_caches(tmp_path, quick_preparation):
    folder, cache = tmp_path / "meshes", tmp_path / "cache"
    (folder / "deep").mkdir(parents=True)
    trimesh.creation.box((100, 80, 60)).export(folder / "deep" / "box.stl")
    (folder / "objects.csv").write_text(
        "path,name,licence,author,url\ndeep/box.stl,Box,CC0-1.0,Ann,http://x\n"
    )
    library = MeshFolder(folder, REFERENCE_READING, quick_preparation, cache)
    assert library.uids() == ("folder/deep/box",)
    first = library.load("folder/deep/box")
    assert (first.name, first.licence, first.author) == ("Box", "CC0-1.0", "Ann")
    assert library.describe("folder/deep/box").licence == "CC0-1.0"
    assert library.measure("folder/deep/box").texture == first.texture
    np.testing.assert_allclose(np.ptp(first.mesh.verts_obj, axis=0), [0.10, 0.06, 0.08])
    again = library.load("folder/deep/box")
    np.testing.assert_array_equal(first.watertight.verts_obj, again.watertight.verts_obj)
    assert len(list(cache.iterdir())) == 1


@pytest.fixture
def noted_folder(tmp_path, quick_preparation):
    """A folder with a.stl and b.stl, opened with the licence of b.stl."""

    def make(licence: str) -> MeshFolder:
        for name in ("a", "b"):
            trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / f"{name}.stl")
        (tmp_path / "objects.csv").write_text(f"path,licence\na.stl,mit\nb.stl,{licence}\n")
        return MeshFolder(tmp_path, REFERENCE_READING, quick_preparation, tmp_path / "cache")

    return make


@pytest.mark.parametrize(
    ("written", "spdx"),
    [
        ("cc0", "CC0-1.0"),
        (" cc-by-4.0 ", "CC-BY-4.0"),
        ("LicenseRef-Ours", "LicenseRef-Ours"),
        ("by AND mit", "CC-BY-4.0 AND MIT"),
        ("", "NOASSERTION"),
        ("  ", "NOASSERTION"),
    ],
)
def test_folder_licences_become_spdx_ids(noted_folder, written, spdx):
    assert noted_folder(written).describe("folder/b").licence == spdx


def test_folder_licence_with_a_typo_is_named(noted_folder):
    problem = r"objects\.csv: row 3 \(b\.stl\): the licence 'cc00' is not known.*mean 'cc0'"
    with pytest.raises(ObjectError, match=problem):
        noted_folder("cc00")


def test_empty_folder_is_refused(tmp_path, quick_preparation):
    with pytest.raises(ObjectError, match="holds no meshes"):
        MeshFolder(tmp_path, REFERENCE_READING, quick_preparation, tmp_path)
    with pytest.raises(ObjectError, match="is not a folder"):
        MeshFolder(tmp_path / "none", REFERENCE_READING, quick_preparation, tmp_path)


@pytest.mark.skipif(not GRASPXL.is_dir(), reason="the GraspXL sample is not here")
def test_graspxl_meshes_load_as_a_folder(tmp_path, quick_preparation):
    library = MeshFolder(GRASPXL, REFERENCE_READING, quick_preparation, tmp_path)
    assert len(library.uids()) == 20
    for uid in library.uids()[::5]:
        asset = library.load(uid)
        watertight = trimesh.Trimesh(asset.watertight.verts_obj, asset.watertight.faces, process=False)
        assert watertight.is_watertight
        assert 0.06 < np.ptp(asset.mesh.verts_obj, axis=0).min() < 0.09


@pytest.fixture
def opened(tmp_path, quick_preparation):
    """`tmp_path`/meshes, opened."""

    def open_folder() -> MeshFolder:
        library = MeshFolder(tmp_path / "meshes", REFERENCE_READING, quick_preparation, tmp_path / "cache")
        assert isinstance(library, ObjectLibrary)
        return library

    return open_folder


def box_at(path: Path, side_m: float = 0.1, *, color: tuple[int, int, int] | None = None) -> Path:
    """A box of 1 : 0.8 : 0.6 in the format of the path; `color`: with vertex colours (PLY and GLB)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    box = trimesh.creation.box(np.array([1.0, 0.8, 0.6]) * side_m)
    if color is not None:
        box.visual.vertex_colors = [*color, 255]
    box.export(path)
    return path


def test_files_of_one_object_are_one_and_the_colored_one_is_drawn(tmp_path, opened):
    """OBJ comes before PLY, but here only the PLY has colours."""
    folder = tmp_path / "meshes" / "003_cracker_box" / "google_16k"
    box_at(folder / "nontextured.stl")
    box_at(folder / "nontextured.ply")
    box_at(folder / "textured.obj")
    box_at(folder.parent / "poisson" / "textured.ply", color=(200, 0, 0))
    box_at(tmp_path / "meshes" / "mug.glb")
    box_at(tmp_path / "meshes" / "mug.stl")
    library = opened()
    assert library.uids() == ("folder/003_cracker_box", "folder/mug")
    red = library.measure("folder/003_cracker_box").fingerprint.color
    assert red[0] == pytest.approx(200 / 255, abs=0.01)
    assert red[1] < 0.01
    joined = [note for note in library.notes() if note.startswith("one object by name")]
    assert len(joined) == 2
    assert (
        "003_cracker_box/poisson/textured.ply is drawn, not 003_cracker_box/google_16k/textured.obj"
        in joined[0]
    )


def test_where_the_first_file_is_broken_the_next_is_drawn_and_it_is_said(tmp_path, opened):
    (box_at(tmp_path / "meshes" / "mug.stl").parent / "mug.glb").write_bytes(b"glTF, they said")
    library = opened()
    measured = library.measure("folder/mug")
    assert measured.fingerprint.size_m > 0
    assert any("mug.glb" in note and "not drawn" in note for note in measured.notes)
    assert library.load("folder/mug").uid == "folder/mug"


@pytest.mark.parametrize(
    ("written", "drawn"),
    [
        ("cups/Tasse é.stl", "cups/Tasse é"),
        ("./cups//Tasse é.stl", "cups/Tasse é"),
        ("cups\\Tasse é.stl ", "cups/Tasse é"),
        ("CUPS/tasse É.STL", "cups/Tasse é"),
        ("cups/Tasse e\u0301.stl", "cups/Tasse é"),
        ("cups/x/../Tasse é.stl", "cups/Tasse é"),
        ("cups/Tasse é", "cups/Tasse é"),
        ("'cups/Tasse é.stl'", "cups/Tasse é"),
        ("004_sugar_box", "004_sugar_box"),
        ("004_sugar_box/google_16k", "004_sugar_box"),
        ("004_sugar_box/google_16k/nontextured.stl", "004_sugar_box"),
    ],
)
def test_a_row_finds_its_object_however_it_is_spelled(tmp_path, opened, written, drawn):
    box_at(tmp_path / "meshes" / "cups" / "Tasse e\u0301.stl")  # decomposed, as a Mac writes
    for name in ("textured.obj", "nontextured.stl"):
        box_at(tmp_path / "meshes" / "004_sugar_box" / "google_16k" / name)
    (tmp_path / "meshes" / "objects.csv").write_text(f'path,licence\n"{written}",CC0\n', encoding="utf-8")
    library = opened()
    licences = {uid: library.describe(uid).licence for uid in library.uids()}
    assert licences == dict.fromkeys(library.uids(), "NOASSERTION") | {f"folder/{drawn}": "CC0-1.0"}
    assert not [note for note in library.notes() if "objects.csv" in note]


def test_the_table_may_lie_outside_of_the_case_that_we_expect(tmp_path, opened):
    box_at(tmp_path / "meshes" / "a.stl")
    (tmp_path / "meshes" / "Objects.CSV").write_text(f"path,licence\n{tmp_path}/meshes/a.stl,CC0\n")
    assert opened().describe("folder/a").licence == "CC0-1.0"


def test_rows_that_fit_nothing_are_named_with_what_they_may_mean(tmp_path, opened):
    for name in ("Mug.stl", "mUg.stl", "cup.stl"):
        box_at(tmp_path / "meshes" / name)
    rows = "cupp.stl,CC0\nmug.stl,CC0\n../cup.stl,CC0\n" + "far/away.glb,CC0\n" * 4
    (tmp_path / "meshes" / "objects.csv").write_text(f"path,licence\n{rows}")
    library = opened()
    (note,) = (note for note in library.notes() if "objects.csv" in note)
    assert "row 2 (cupp.stl; did you mean cup.stl?)" in note
    assert "row 3 (mug.stl" in note  # two files in other cases
    assert "row 4 (../cup.stl" in note
    assert note.endswith("and 2 more")
    assert {library.describe(uid).licence for uid in library.uids()} == {"NOASSERTION"}


def test_two_rows_of_one_object_that_differ_are_refused(tmp_path, opened):
    box_at(tmp_path / "meshes" / "a.stl")
    box_at(tmp_path / "meshes" / "a.glb")
    table = tmp_path / "meshes" / "objects.csv"
    table.write_text("path,licence\na.stl,CC0\n./a.stl,CC0\na.glb,CC0\n")
    assert opened().describe("folder/a").licence == "CC0-1.0"
    table.write_text("path,licence\na.stl,CC0\na.glb,MIT\n")
    assert opened().describe("folder/a").licence == "MIT"  # of the drawn file
    table.write_text("path,licence\n./a.stl,CC0\na.stl,MIT\n")
    with pytest.raises(ObjectError, match=r"rows 2 \(\./a\.stl\) and 3 \(a\.stl\) tell different things"):
        opened()


def test_names_of_any_kind_load(tmp_path, opened):
    names = [
        b"batch@1/cup@mirrored.stl",
        b"two\nlines.stl",
        b"not\xffutf.stl",
        b"[/b].stl",
        b"x" * 250 + b".stl",
    ]
    for name in names:
        place = tmp_path / "meshes" / os.fsdecode(name)
        box_at(tmp_path / "plain.stl")
        place.parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "plain.stl").rename(place)
    library = opened()
    assert len(library.uids()) == len(names)
    for uid in library.uids():
        assert library.measure(uid).fingerprint.size_m > 0
    assert "folder/batch@1/cup%40mirrored" in library.uids()
    (tmp_path / "meshes" / os.fsdecode(b"not\xffutf.stl")).write_bytes(b"")
    with pytest.raises(ObjectError) as caught:
        opened().measure("folder/not%FFutf")
    str(caught.value).encode("utf-8")


def test_what_is_in_the_way_is_said_and_not_read(tmp_path, opened):
    box_at(tmp_path / "meshes" / "mug.stl")
    (tmp_path / "meshes" / "._mug.stl").write_bytes(b"\0" * 64)
    (tmp_path / "meshes" / "gone.stl").symlink_to("../annex")
    (tmp_path / "meshes" / "lfs.stl").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
    (tmp_path / "meshes" / "linked").write_text("../elsewhere")
    os.mkfifo(tmp_path / "meshes" / "pipe.stl")
    library = opened()
    assert "hidden files left out: ._mug.stl" in library.notes()
    assert any("unpacked as text" in note and "linked" in note for note in library.notes())
    for uid, problem in (
        ("folder/gone", "which is not there"),
        ("folder/lfs", "a Git LFS pointer"),
        ("folder/pipe", "a pipe"),
    ):
        with pytest.raises(ObjectError, match=problem):
            library.measure(uid)


def test_a_file_that_goes_while_the_folder_is_open_is_one_line(tmp_path, opened):
    path = box_at(tmp_path / "meshes" / "mug.stl")
    library = opened()
    path.unlink()
    with pytest.raises(ObjectError, match=r"mug\.stl"):
        library.measure("folder/mug")
    path.symlink_to(path)  # going round: an error of the system
    with pytest.raises(ObjectError, match=r"mug\.stl"):
        library.measure("folder/mug")


def test_the_state_changes_with_any_file(tmp_path):
    box_at(tmp_path / "a" / "mug.stl")
    states = {folder_state(tmp_path)}
    (tmp_path / "gone.stl").symlink_to("nowhere")
    states.add(folder_state(tmp_path))
    (tmp_path / os.fsdecode(b"\xff.mtl")).write_bytes(b"x")
    states.add(folder_state(tmp_path))
    (tmp_path / os.fsdecode(b"\xff.mtl")).write_bytes(b"xy")
    states.add(folder_state(tmp_path))
    assert len(states) == 4
    assert folder_state(tmp_path) in states


def test_what_is_no_folder_of_meshes_is_refused(tmp_path, quick_preparation):
    file = tmp_path / "file.glb"
    file.write_bytes(b"x")
    (tmp_path / "hidden").mkdir()
    (tmp_path / "hidden" / "._a.glb").write_bytes(b"x")
    for path, problem in (
        (file, "is not a folder"),
        (tmp_path / ("x" * 300), "is not a folder"),
        (tmp_path / "hidden", r"holds no meshes; hidden files left out: \._a\.glb"),
    ):
        with pytest.raises(ObjectError, match=problem):
            MeshFolder(path, REFERENCE_READING, quick_preparation, tmp_path)
