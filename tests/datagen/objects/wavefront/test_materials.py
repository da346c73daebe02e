"""MTL as exporters write it: names, texture files, numbers, notes on what is guessed."""

import io
import os
import time
import unicodedata

import numpy as np
import pytest
from PIL import Image

from datagen.objects.errors import ObjectError
from datagen.objects.formats.reading import ReadingConfig, read_object
from datagen.objects.mesh.surface_points import sample_surface
from datagen.objects.wavefront.mtl_file import read_mtl
from datagen.objects.wavefront.obj_file import read_obj
from shards.color import linear_from_srgb, srgb_from_linear

RED = linear_from_srgb(np.array([0.9, 0.05, 0.05]))
BLUE = linear_from_srgb(np.array([0.05, 0.05, 0.9]))


def png(color=(200, 30, 30)) -> bytes:
    buffer = io.BytesIO()
    Image.new("RGB", (8, 8), color).save(buffer, format="PNG")
    return buffer.getvalue()


def entry(tmp_path, text: str):
    (found,) = read_mtl(tmp_path / "a.mtl", f"newmtl m\n{text}").values()
    return found


NAMES = {  # usemtl, newmtl, whether that is a guess
    "plain": ("red", "red", False),
    "blanks": ("old wood", "old wood", False),
    "two blanks": ("old  wood", "old  wood", False),
    "two blanks became one": ("old wood", "old  wood", True),
    "number sign": ("Material #25", "Material #25", False),
    "comment behind usemtl": ("red # the paint", "red", False),
    "comment behind newmtl": ("red", "red # the paint", False),
    "number sign and comment": ("Material #25 # red", "Material #25", False),
    "quoted once": ('"red"', "red", False),
    "quoted twice": ("'old wood'", "'old wood'", False),
    "other case": ("Red", "red", True),
    "accents": ("Küche", "Küche", False),
    "tab": ("red\t", "red", False),
    "a name that is an option": ("-s 1", "-s 1", False),
}


@pytest.mark.parametrize("kind", NAMES)
def test_usemtl_finds_newmtl(kind, obj, tetrahedron):
    used, new, guessed = NAMES[kind]
    others = "newmtl Material #26\nKd 0 1 0\nnewmtl other\nKd 0 0 1\n"
    mtl = f"newmtl  {new}\n\tKd 0.9 0.05 0.05\n{others}"
    mesh = obj(f"mtllib a.mtl\nusemtl {used}\n{tetrahedron}", **{"a.mtl": mtl})
    np.testing.assert_allclose(mesh.materials[0].base_color_rgba[:3], RED)
    assert bool(mesh.notes) is guessed


def test_another_number_is_another_material(obj, tetrahedron):
    with pytest.raises(ObjectError, match="material 'Material #27' is in none"):
        obj(
            f"mtllib a.mtl\nusemtl Material #27\n{tetrahedron}",
            **{"a.mtl": "newmtl Material #25\nKd 1 0 0\n"},
        )


LIBRARIES = {
    "two on a line": ("mtllib a.mtl b.mtl", ("a.mtl", "b.mtl")),
    "two lines": ("mtllib a.mtl\nmtllib b.mtl", ("a.mtl", "b.mtl")),
    "at the end": ("\n", ("a.mtl", "b.mtl")),
    "with blanks": ("mtllib my a.mtl my b.mtl", ("my a.mtl", "my b.mtl")),
    "quoted": ("mtllib \"my a.mtl\" 'b.mtl'", ("my a.mtl", "b.mtl")),
    "one name with two endings": ("mtllib a.mtl b.mtl\nmtllib c.mtl", ("a.mtl b.mtl", "c.mtl")),
    "other case": ("mtllib A.MTL b.mtl # both", ("a.mtl", "B.mtl")),
    "in folders": ("mtllib ./maps/a.mtl maps\\b.mtl", ("maps/a.mtl", "maps/b.mtl")),
}


@pytest.mark.parametrize("kind", LIBRARIES)
def test_every_library_of_every_line_is_read(kind, obj, tetrahedron):
    lines, (first, second) = LIBRARIES[kind]
    text = f"{lines}\nusemtl ma\n{tetrahedron}usemtl mb\nf 1 2 3\n"
    if kind == "at the end":
        text += "mtllib a.mtl b.mtl"
    mesh = obj(text, **{first: "newmtl ma\nKd 1 0 0\n", second: "newmtl mb\nKd 0 0 1"})
    assert [material.base_color_rgba[:3] for material in mesh.materials] == [(1, 0, 0), (0, 0, 1)]
    assert mesh.face_material.tolist() == [0, 0, 0, 0, 1]
    assert mesh.notes == ()


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_a_library_may_have_another_encoding(encoding, obj, tetrahedron):
    mtl = "newmtl Küche\nKd 0.9 0.05 0.05\n".encode(encoding)
    mesh = obj(f"mtllib a.mtl\nusemtl Küche\n{tetrahedron}", **{"a.mtl": mtl})
    np.testing.assert_allclose(mesh.materials[0].base_color_rgba[:3], RED)


def test_without_any_library_materials_are_grey_with_a_note(obj, tetrahedron):
    mesh = obj(f"usemtl red\n{tetrahedron}usemtl (null)\nf 1 2 3\n")
    assert len(mesh.materials) == 2
    np.testing.assert_allclose(mesh.materials[0].base_color_rgba[:3], linear_from_srgb(np.full(3, 0.6)))
    assert mesh.notes == ("no MTL file tells of 2 materials ('red', '(null)'); they are drawn grey",)


def test_a_file_of_the_same_name_stands_in_for_a_library_that_is_not_there(obj, tetrahedron):
    mesh = obj(
        f"mtllib Untitled.mtl\nusemtl red\n{tetrahedron}", **{"a.mtl": "newmtl red\nKd 0.9 0.05 0.05\n"}
    )
    np.testing.assert_allclose(mesh.materials[0].base_color_rgba[:3], RED)
    assert mesh.notes == (
        "material library 'Untitled.mtl' is missing",
        "no mtllib line names a file that is there; 'a.mtl' is read",
    )


def test_a_missing_library_is_refused_only_where_a_face_needs_it(obj, tetrahedron):
    unused = obj(f"mtllib b.mtl\n{tetrahedron}")
    assert unused.notes == ("no usemtl line: material library 'b.mtl' is not used",)
    switched_off = obj(f"mtllib b.mtl\nusemtl x\nusemtl \n{tetrahedron}")
    assert switched_off.notes == ("material library 'b.mtl' is missing",)
    with pytest.raises(ObjectError, match=r"material library 'b\.mtl' is missing"):
        obj(f"mtllib b.mtl\nusemtl x\n{tetrahedron}")


def test_what_is_defined_twice_is_told_of(obj, tetrahedron):
    text = f"mtllib a.mtl b.mtl\nusemtl m\n{tetrahedron}"
    twice = obj(text, **{"a.mtl": "newmtl m\nKd 0 1 0\nnewmtl m\nKd 1 0 0\n", "b.mtl": "newmtl n\n"})
    assert twice.materials[0].base_color_rgba[:3] == (1, 0, 0)
    assert "several times" in " ".join(twice.notes)
    in_both = obj(text, **{"a.mtl": "newmtl m\nKd 0 1 0\n", "b.mtl": "newmtl m\nKd 1 0 0\n"})
    assert in_both.materials[0].base_color_rgba[:3] == (1, 0, 0)
    assert in_both.notes == ("material 'm' is in two libraries; that of 'b.mtl' counts",)
    assert obj(text, **{"b.mtl": "newmtl m\nKd 0 1 0\n"}).notes == ()  # both say the same


def test_thousands_of_names_in_another_case_take_no_minutes(obj):
    count = 3000
    uses = "".join(f"usemtl m{k}\nf 1 2 3\n" for k in range(count))
    mtl = "".join(f"newmtl M{k}\nKd 1 0 0\n" for k in range(count))
    start = time.process_time()
    mesh = obj("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\n" + uses, **{"a.mtl": mtl})
    assert time.process_time() - start < 5
    assert len(mesh.materials) == count
    assert mesh.notes[0] == "material 'm0' is taken to be 'M0'"
    assert mesh.notes[-1] == f"and {count - 20} more notes"


def test_messages_do_not_repeat_a_whole_file(obj):
    with pytest.raises(ObjectError, match="is missing") as caught:
        obj(TEXTURED, **{"a.mtl": f"newmtl m\nmap_Kd {'a #' * 100_000}\n"})
    assert len(str(caught.value)) < 600


TEXTURED = "mtllib a.mtl\nusemtl m\nvt 0 0\nvt 1 0\nvt 0 1\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/2 3/3\n"

TEXTURES = {  # the rest of the map_Kd line, the file it means, whether that is a guess
    "plain": ("wood.png", "wood.png", False),
    "blanks": ("my wood.png", "my wood.png", False),
    "two blanks": ("my  wood.png", "my  wood.png", False),
    "quoted": ('"my wood.png"', "my wood.png", False),
    "other case": ("Wood.PNG", "wood.png", False),
    "folder in another case": ("Maps/Wood.png", "maps/wood.png", False),
    "backslash": ("maps\\wood.png", "maps/wood.png", False),
    "two backslashes": ("maps\\\\wood.png", "maps/wood.png", False),
    "dot": (".\\maps\\wood.png", "maps/wood.png", False),
    "Windows": ("C:\\Users\\me\\maps\\wood.png", "wood.png", True),
    "Windows, with its folder": ("C:\\Users\\me\\maps\\wood.png", "maps/wood.png", True),
    "network share": ("\\\\server\\maps\\wood.png", "wood.png", True),
    "Mac": ("/Users/me/maps/wood.png", "wood.png", True),
    "URL": ("file:///C:/maps/wood.png", "wood.png", True),
    "flattened": ("maps/wood.png", "wood.png", True),
    "above": ("../maps/wood.png", "maps/wood.png", True),
    "URL-encoded": ("my%20wood.png", "my wood.png", False),
    "a true %20": ("my%20wood.png", "my%20wood.png", False),
    "number sign": ("wood#2.png", "wood#2.png", False),
    "blank and number sign": ("wood #2.png", "wood #2.png", False),
    "comment": ("wood.png # oak", "wood.png", False),
    "comment behind quotes": ('"my wood.png" # oak', "my wood.png", False),
    "options": ("-blendu on -blendv off -cc off -clamp on -texres 512 wood.png", "wood.png", False),
    "scale": ("-s 2 2 1 my wood.png", "my wood.png", False),
    "scale of one": ("-s 1 my wood.png", "my wood.png", False),
    "a name that begins with a number": ("-o 0 0 0 -s 1 1 1 2 wood.png", "2 wood.png", False),
    "a number that is a name": ("-s 1 1 1 2.png", "2.png", False),
    "bump and channel": ("-bm 0.2 -imfchan l wood.png", "wood.png", False),
    "gain": ("-mm 0 1 wood.png", "wood.png", False),
    "options behind": ("wood.png -s 1 1 1", "wood.png", False),
    "a name like an option": ("-wood.png", "-wood.png", False),
    "composed accents": (
        unicodedata.normalize("NFC", "Küche.png"),
        unicodedata.normalize("NFD", "Küche.png"),
        False,
    ),
    "tab": ("\twood.png\t", "wood.png", False),
}


@pytest.mark.parametrize("kind", TEXTURES)
def test_textures_are_found_as_they_are_named(kind, obj):
    rest, file, guessed = TEXTURES[kind]
    mesh = obj(TEXTURED, **{"a.mtl": f"newmtl m\nmap_Kd {rest}\n", file: png()})
    assert mesh.materials[0].base_color_image == png()
    assert bool(mesh.notes) is guessed


def test_textures_lie_beside_the_mtl_or_beside_the_obj(obj):
    text = TEXTURED.replace("a.mtl", "look/a.mtl")
    mtl = "newmtl m\nmap_Kd wood.png\nmap_Ke ../glow.png\n"
    mesh = obj(text, **{"look/a.mtl": mtl, "wood.png": png((1, 2, 3)), "glow.png": png()})
    assert mesh.materials[0].base_color_image == png((1, 2, 3))
    assert mesh.materials[0].emissive_image == png()
    assert mesh.materials[0].emissive_rgb == (1.0, 1.0, 1.0)  # without Ke it would show nothing
    closer = obj(text, **{"look/wood.png": png((7, 7, 7))})
    assert closer.materials[0].base_color_image == png((7, 7, 7))


@pytest.mark.parametrize("name", ["../private/x.png", "{outside}/x.png", "link.png", "linked/x.png"])
def test_nothing_outside_of_the_folder_is_opened(name, tmp_path_factory, tmp_path, obj):
    outside = tmp_path_factory.mktemp("private")
    (outside / "x.png").write_bytes(png())
    (tmp_path.parent / "private").mkdir(exist_ok=True)
    (tmp_path.parent / "private" / "x.png").write_bytes(png())
    os.symlink(outside / "x.png", tmp_path / "link.png")
    os.symlink(outside, tmp_path / "linked")
    with pytest.raises(ObjectError, match=r"texture .* is missing"):
        obj(TEXTURED, **{"a.mtl": f"newmtl m\nmap_Kd {name.format(outside=outside)}\n"})


def test_links_of_a_download_cache_are_followed(tmp_path, obj):
    """A folder of links whose files lie side by side, under other names."""
    (tmp_path / "blobs").mkdir()
    contents = {"a.obj": TEXTURED.encode(), "a.mtl": b"newmtl m\nmap_Kd wood.png\n", "wood.png": png()}
    (tmp_path / "snapshot").mkdir()
    for index, (name, content) in enumerate(contents.items()):
        (tmp_path / "blobs" / str(index)).write_bytes(content)
        os.symlink(f"../blobs/{index}", tmp_path / "snapshot" / name)
    mesh = read_obj(tmp_path / "snapshot" / "a.obj", max_file_mb=1.0)
    assert mesh.materials[0].base_color_image == png()


@pytest.mark.parametrize(
    "name", ["x" * 5000 + ".png", "loop.png", ".", "..", "/", "maps", "\ud800.png", "a/" * 3000 + "b"]
)
def test_names_that_no_disk_can_hold_are_missing_textures(name, tmp_path, obj):
    (tmp_path / "maps").mkdir()
    os.symlink("loop.png", tmp_path / "loop.png")
    mtl = f"newmtl m\nmap_Kd {name}\n".encode("utf-8", "surrogatepass")
    with pytest.raises(ObjectError, match="is missing"):
        obj(TEXTURED, **{"a.mtl": mtl})


@pytest.mark.parametrize("big", ["a.obj", "a.mtl", "wood.png"])
def test_every_file_has_a_largest_size(big, obj):
    files = {"a.mtl": b"newmtl m\nmap_Kd wood.png\n", "wood.png": png(), "a.obj": TEXTURED.encode()}
    files[big] += b"\n" * 20_000
    text = files.pop("a.obj")
    with pytest.raises(ObjectError, match=rf"{big}: has 0 MB; expected at most 0.01 MB"):
        obj(text, max_file_mb=0.01, **files)


def test_scale_and_offset_of_the_image_move_its_coordinates(obj):
    mesh = obj(TEXTURED, **{"a.mtl": "newmtl m\nmap_Kd -s 2 3 1 -o 0.5 0.25 wood.png\n", "wood.png": png()})
    np.testing.assert_allclose(mesh.corner_uv[0], [[0.5, 0.25], [2.5, 0.25], [0.5, 3.25]])


@pytest.mark.parametrize(("option", "first", "last"), [("-clamp on", BLUE, BLUE), ("-clamp off", RED, BLUE)])
def test_a_clamped_image_shows_its_border_beyond_it_and_others_repeat(tmp_path, option, first, last):
    """A red and a blue half, seen from u = 1 to u = 2."""
    halves = np.repeat(np.round(srgb_from_linear(np.array([RED, BLUE])) * 255).astype(np.uint8), 8, axis=0)
    Image.fromarray(np.repeat(halves[None], 4, axis=0)).save(tmp_path / "halves.png")
    (tmp_path / "a.mtl").write_text(f"newmtl m\nmap_Kd {option} halves.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nusemtl m\nvt 1.0 0.5\nvt 2.0 0.5\nv 0 0 0\nv 0.2 0 0\nv 0.2 0.1 0\nv 0 0.1 0\n"
        "f 1/1 2/2 3/2 4/1\n"
    )
    config = ReadingConfig(unit="m", up_axis="z", max_faces=9, max_image_px=99)
    found = sample_surface(read_object(tmp_path / "a.obj", config).mesh, 500, np.random.default_rng(0))
    along = (found.points_obj[:, 0] - found.points_obj[:, 0].min()) / np.ptp(found.points_obj[:, 0])
    for part, color in (((along > 0.1) & (along < 0.4), first), (along > 0.6, last)):
        assert part.sum() > 50
        np.testing.assert_allclose(
            linear_from_srgb(found.colors[part].astype(float)).mean(axis=0), color, atol=0.03
        )


def test_textured_faces_without_coordinates_are_told_of(obj):
    mesh = obj(TEXTURED + "f 1 2 3\n", **{"a.mtl": "newmtl m\nmap_Kd wood.png\n", "wood.png": png()})
    assert mesh.notes == ("1 textured faces have no texture coordinates and show one texel",)


def test_vertex_colours_of_textured_faces_are_left_out_with_a_note(obj):
    text = TEXTURED.replace("v 0 0 0\n", "v 0 0 0 1 0 0\n") + "usemtl plain\nf 1 2 3\n"
    mtl = "newmtl m\nmap_Kd wood.png\nnewmtl plain\nKd 0.5 0.5 0.5\n"
    mesh = obj(text, **{"a.mtl": mtl, "wood.png": png()})
    np.testing.assert_array_equal(mesh.corner_colors[0], np.ones((3, 3)))
    np.testing.assert_array_equal(mesh.corner_colors[1], [[1, 0, 0], [1, 1, 1], [1, 1, 1]])
    assert "vertex colours of 1 textured faces" in " ".join(mesh.notes)


@pytest.mark.parametrize(
    ("kd", "base"), [("", 1.0), ("Kd 0.8 0.8 0.8", 1.0), ("Kd 0 0 0", 0.0), ("Kd 1 1 1", 1.0)]
)
def test_vertex_colours_multiply_a_chosen_kd(kd, base, obj):
    text = "mtllib a.mtl\nusemtl m\nv 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 0 1 0 1 0 0\nf 1 2 3\n"
    mesh = obj(text, **{"a.mtl": f"newmtl m\n{kd}\n"})
    assert mesh.materials[0].base_color_rgba[:3] == (base, base, base)
    np.testing.assert_array_equal(mesh.corner_colors, [[[1, 0, 0]] * 3])


def test_bump_maps_that_hold_normals_are_normal_maps(obj):
    normals, heights = png((128, 127, 250)), png((90, 90, 90))
    mtl = "newmtl m\nmap_Bump -bm 1.0 bump.png\nmap_d cut.png\nmap_Ks cut.png\n"
    blue = obj(TEXTURED, **{"a.mtl": mtl, "bump.png": normals})
    assert blue.materials[0].normal_image == normals
    assert blue.notes == ("images left out: map_d of 1 materials, map_ks of 1 materials",)
    grey = obj(TEXTURED, **{"bump.png": heights})
    assert grey.materials[0].normal_image is None
    assert "map_bump of 1 materials" in " ".join(grey.notes)
    assert "map_bump" in " ".join(obj(TEXTURED, **{"bump.png": b"no image"}).notes)


OPACITY = {  # lines, opacity, whether there is a note
    "nothing": ("", 1.0, False),
    "d": ("d 0.4", 0.4, False),
    "halo": ("d -halo 0.4", 0.4, False),
    "Tr 1": ("Tr 1.000", 1.0, True),
    "Tr 0": ("Tr 0", 1.0, False),
    "Tr between": ("Tr 0.25", 0.75, True),
    "both, 1 - d": ("Tr 0.25\nd 0.75", 0.75, False),
    "both, as d": ("d 1.0\nTr 1.0", 1.0, True),
    "d 0": ("d 0", 0.0, True),
    "no number": ("d 1.#QNAN", 1.0, True),
    "comment": ("d 0.4 # 1 is opaque", 0.4, False),
    "tabs": ("\td\t0.4\t", 0.4, False),
}


@pytest.mark.parametrize("kind", OPACITY)
def test_opacity_is_never_guessed_without_a_word(kind, tmp_path):
    lines, opacity, noted = OPACITY[kind]
    found = entry(tmp_path, lines)
    assert found.opacity == pytest.approx(opacity)
    assert bool(found.notes) is noted


KD = {  # what follows Kd, the display colour it means
    "three": ("0.9 0.05 0.05", (0.9, 0.05, 0.05)),
    "one": ("0.5", (0.5, 0.5, 0.5)),
    "comment": ("0.9 0.05 0.05 # red", (0.9, 0.05, 0.05)),
    "bytes": ("204 51 51", (0.8, 0.2, 0.2)),
    "xyz of white": ("xyz 0.9505 1.0 1.0890", (1.0, 1.0, 1.0)),
    "xyz, one": ("xyz 0", (0.0, 0.0, 0.0)),
    "spectral": ("spectral red.rfl 1.0", None),
    "nothing": ("", None),
    "no number": ("nan nan nan", None),
}


@pytest.mark.parametrize("kind", KD)
def test_kd_in_all_its_forms(kind, tmp_path):
    rest, display = KD[kind]
    found = entry(tmp_path, f"Kd {rest}\n")
    assert found.kd == (None if display is None else pytest.approx(display, abs=1e-3))
    assert bool(found.notes) is (kind in ("bytes", "spectral", "no number"))


def test_ka_stands_in_for_a_kd_that_is_not_there(tmp_path):
    assert entry(tmp_path, "Ka 1 0 0\nKd 0 1 0\n").kd == (0, 1, 0)
    assert entry(tmp_path, "Ka 1 0 0\nmap_Kd a.png\n").kd is None
    found = entry(tmp_path, "Ka 1 0 0\n")
    assert found.kd == (1, 0, 0)
    assert found.notes == ("material 'm': has no Kd; Ka is taken for it",)


def test_highlights_that_illum_switches_off_make_no_metal(obj, tetrahedron):
    mtl = "newmtl m\nKd 0.5 0.5 0.5\nKs 1 1 1\nillum {}\n"
    text = f"mtllib a.mtl\nusemtl m\n{tetrahedron}"
    assert obj(text, **{"a.mtl": mtl.format(1)}).materials[0].metallic == 0.0
    assert obj(text, **{"a.mtl": mtl.format(2)}).materials[0].metallic == 1.0


def test_numbers_out_of_range_stay_within_what_gltf_permits(obj, tetrahedron):
    mesh = obj(
        f"mtllib a.mtl\nusemtl m\n{tetrahedron}", **{"a.mtl": "newmtl m\nPr 1.7\nPm -2\nKd 1.2 -1 0\n"}
    )
    material = mesh.materials[0]
    assert (material.roughness, material.metallic) == (1.0, 0.0)
    assert material.base_color_rgba == (1.0, 0.0, 0.0, 1.0)


def test_a_number_of_an_mtl_that_cannot_be_read_is_named_with_its_line(tmp_path):
    with pytest.raises(
        ObjectError, match=r"a\.mtl: line 2 cannot be read: 'kd 0,8 0,8 0,8' .*decimal comma"
    ) as caught:
        entry(tmp_path, "Kd 0,8 0,8 0,8\n")
    assert "\n" not in str(caught.value)
