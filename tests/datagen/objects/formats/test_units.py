"""The unit of files that state none, and what is said about it."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import ReadingConfig, read_object
from datagen.objects.formats.units import METRES_PER, unit_of_size
from datagen.objects.mesh.graspable_size import HELD_LONGEST_M, HOLDABLE_SIDES_M
from datagen.objects.stores.folder import MeshFolder
from datagen.objects.stores.library import REFERENCE_READING


@pytest.mark.parametrize(
    ("longest", "unit"),
    [
        (0.2, "m"),
        (0.9, "m"),
        (1.8, "cm"),  # neither 1.8 m nor 1.8 mm is held
        (9.5, "cm"),
        (30.0, "cm"),
        (60.0, "mm"),  # 6 cm is nearer to what is held than 60 cm
        (95.0, "mm"),
        (180.0, "mm"),
    ],
)
def test_auto_unit(longest, unit):
    assert unit_of_size(longest)[0] == unit


@pytest.mark.parametrize(("longest", "unit"), [(0.2, "m"), (1.8, "cm"), (16.0, "mm"), (95.0, "mm")])
def test_customary_unit_wins_where_it_is_plausible(longest, unit):
    assert unit_of_size(longest, customary="mm")[0] == unit


@pytest.mark.parametrize("customary", [None, "mm"])
def test_chosen_size_is_held_in_a_hand_wherever_one_is(customary):
    for longest in np.geomspace(HELD_LONGEST_M[0], 1e3 * HELD_LONGEST_M[1], 500):
        metres = longest * METRES_PER[unit_of_size(longest, customary=customary)[0]]
        assert HELD_LONGEST_M[0] * 0.999 <= metres <= HELD_LONGEST_M[1] * 1.001


def test_note_says_what_else_is_plausible():
    for longest, other in ((0.8, "0.8 cm"), (9.5, "9.5 mm"), (95.0, "95 cm"), (1.8, "no hand holds it in m")):
        (note,) = unit_of_size(longest)[1]
        assert other in note
        assert "`objects.reading.unit`" in note
        assert "\n" not in note
    assert unit_of_size(0.1)[1] == unit_of_size(180.0)[1] == ()


def test_typical_size_lies_in_the_middle_of_the_limits():
    assert np.sqrt(HOLDABLE_SIDES_M[0] * HOLDABLE_SIDES_M[2]) == pytest.approx(HOLDABLE_SIDES_M[1], rel=0.01)


@pytest.mark.parametrize(
    ("name", "sides", "unit", "size_m"),
    [
        ("mug.stl", (80, 95, 80), "mm", 0.095),
        ("die.stl", (16, 16, 16), "mm", 0.016),
        ("mug.ply", (8, 9.5, 8), "cm", 0.095),
        ("mug.ply", (80, 95, 80), "mm", 0.095),
        ("mug.obj", (0.08, 0.095, 0.08), "m", 0.095),
    ],
)
def test_hand_sized_objects_are_recognised(tmp_path, name, sides, unit, size_m):
    trimesh.creation.box(sides).export(tmp_path / name)
    read = read_object(tmp_path / name, REFERENCE_READING)
    assert read.unit == unit
    assert np.ptp(read.mesh.verts_obj, axis=0).max() == pytest.approx(size_m, rel=1e-6)
    assert len(read.notes) == (unit != "m")


def test_stated_unit_is_taken_without_a_note(tmp_path):
    trimesh.creation.box((80, 95, 80)).export(tmp_path / "a.stl")
    config = ReadingConfig(unit="cm", up_axis="y", max_faces=99, max_image_px=9)
    read = read_object(tmp_path / "a.stl", config)
    assert (read.unit, read.notes) == ("cm", ())


@pytest.mark.parametrize(
    ("name", "longest"),
    [("a.glb", 1e-6), ("a.glb", 50.0), ("a.glb", 1e6), ("a.stl", 4000.0), ("a.ply", 0.001), ("a.obj", 1e5)],
)
def test_absurd_size_is_refused_before_anything_is_made_of_it(tmp_path, quick_preparation, name, longest):
    folder = tmp_path / "meshes"
    folder.mkdir()
    trimesh.creation.box((0.8 * longest, longest, 0.6 * longest)).export(
        folder / name, digits=12
    ) if name.endswith(".obj") else trimesh.creation.box((0.8 * longest, longest, 0.6 * longest)).export(
        folder / name
    )
    library = MeshFolder(folder, REFERENCE_READING, quick_preparation, tmp_path / "cache")
    for use in (library.measure, library.load):
        with pytest.raises(ObjectError, match=r"has a longest side of .* m; expected 0.005 to 1 m"):
            use(f"folder/{Path(name).stem}")
    assert not (tmp_path / "cache").exists()
