"""Files that a mesh names are found where they lie, and nowhere else."""

from pathlib import Path

import pytest

from datagen.objects.files.named_files import NamedFiles, spellings


def file_beside(mesh: Path, written: str) -> Path | None:
    found = NamedFiles(mesh, 1.0).find(spellings(written), (mesh.parent,))
    return None if found is None else found.path


@pytest.fixture
def mesh(tmp_path):
    (tmp_path / "mesh" / "textures").mkdir(parents=True)
    for name in ("Tex.png", "textures/deep.png", "with space.png", "größe.png", "maps\\flat.png"):
        (tmp_path / "mesh" / name).write_bytes(b"")
    (tmp_path / "secret.png").write_bytes(b"")
    return tmp_path / "mesh" / "a.ply"


@pytest.mark.parametrize(
    ("written", "found"),
    [
        ("Tex.png", "Tex.png"),
        ('"Tex.png"', "Tex.png"),
        ("tex.PNG", "Tex.png"),
        ("./textures/deep.png", "textures/deep.png"),
        ("textures\\Deep.png", "textures/deep.png"),
        ("C:\\Users\\Ann\\scan\\tex.png", "Tex.png"),
        ("/home/ann/scan/Tex.png", "Tex.png"),
        ("../elsewhere/Tex.png", "Tex.png"),
        (" with space.png ", "with space.png"),
        ("gro\u0308ße.png", "größe.png"),  # as a Mac spells it
        ("maps\\flat.png", "maps\\flat.png"),  # one name, as a zip of Windows unpacks
    ],
)
def test_written_names_are_found(mesh, written, found):
    assert file_beside(mesh, written).samefile(mesh.parent / found)


@pytest.mark.parametrize(
    "written",
    [
        "none.png",
        "../secret.png",
        "textures",
        "",
        ".",
        "/",
        "a\0b.png",
        "x" * 5000,
        "textures/../../secret.png",
    ],
)
def test_what_is_absent_or_outside_is_not_found(mesh, written):
    assert file_beside(mesh, written) is None


def test_absolute_path_and_link_do_not_lead_out(mesh, tmp_path):
    (mesh.parent / "link.png").symlink_to(tmp_path / "secret.png")
    (mesh.parent / "inner.png").symlink_to("Tex.png")
    assert file_beside(mesh, str(tmp_path / "secret.png")) is None
    assert file_beside(mesh, "link.png") is None
    assert file_beside(mesh, "inner.png") is not None


def test_two_names_that_differ_in_case_alone_are_told_apart(mesh):
    (mesh.parent / "TEX.png").write_bytes(b"")
    assert file_beside(mesh, "TEX.png").name == "TEX.png"
    assert file_beside(mesh, "tex.png") is None
