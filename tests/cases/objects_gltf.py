"""glTF files from the field: what each folder g01 to g22 must read as."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from datagen.objects.errors import ObjectError
from datagen.objects.formats.glb_export import mesh_to_glb
from datagen.objects.formats.reading import ReadObject, object_mesh, read_object
from datagen.objects.gltf.scene import read_gltf
from datagen.objects.mesh.surface_points import sample_surface
from datagen.objects.stores.library import REFERENCE_READING
from shards.color import linear_from_srgb, srgb_from_linear
from tests.cases.outcome import Case

__all__ = ["CASES"]

BOX_M = (0.08, 0.06, 0.10)  # of most files, Z up
GREEN = (0.0, 1.0, 0.0)
# sRGB of the images: a chequered one, in colours or their luminance, and one of four plain quadrants.
Palette = tuple[tuple[int, int, int], ...]
CHECKS: Palette = ((220, 40, 40), (40, 40, 220))
GREY_CHECKS: Palette = ((94, 94, 94), (61, 61, 61))
QUADRANTS: Palette = ((220, 30, 30), (30, 200, 30), (30, 30, 220), (230, 220, 30))
CLAMPED = (1 / 36, 5 / 36, 5 / 36, 25 / 36)  # of each quadrant where UVs run from 0 to 3


def _read(path: Path) -> ReadObject:
    """The file; what is stored of it must read back with the same colours."""
    read = read_object(path, REFERENCE_READING)
    stored = read_gltf(path, mesh_to_glb(read.mesh))
    back = object_mesh(stored, path, REFERENCE_READING, unit="m", up_axis="y").mesh
    ours, theirs = (sample_surface(mesh, 2000, np.random.default_rng(0)).colors for mesh in (read.mesh, back))
    assert np.abs(ours - theirs).max() < 0.01, "the stored mesh has other colours"
    return read


def _colors(path: Path) -> np.ndarray:
    return sample_surface(_read(path).mesh, 4000, np.random.default_rng(0)).colors


def _shares(colors: np.ndarray, palette: Palette) -> np.ndarray:
    """Which part of the surface is nearest to each colour; most of it must have one, where neighbours do not blend."""
    distance = np.linalg.norm(colors[:, None] - np.array(palette) / 255, axis=2)
    assert np.quantile(distance.min(axis=1), 0.6) < 0.02, f"other colours than {palette}"
    return np.bincount(distance.argmin(axis=1), minlength=len(palette)) / len(colors)


def _palette(file: str, palette: Palette, expected: tuple[float, ...]) -> Callable[[Path], str]:
    def check(folder: Path) -> str:
        shares = _shares(_colors(folder / file), palette)
        assert (np.abs(shares - expected) < 0.05).all(), f"shares {shares.round(2)} instead of {expected}"
        return f"{file}: shares {shares.round(2).tolist()} of {palette}"

    return check


def _one_color(file: str, srgb: tuple[float, ...]) -> Callable[[Path], str]:
    def check(folder: Path) -> str:
        colors = _colors(folder / file)
        worst = float(np.abs(colors - np.array(srgb)).max())
        assert worst < 0.01, f"{colors.mean(axis=0).round(2)} instead of {srgb}"
        return f"{file}: sRGB {tuple(colors.mean(axis=0).round(3).tolist())}"

    return check


def _box(file: str, size_m: tuple[float, float, float] = BOX_M) -> Callable[[Path], str]:
    def check(folder: Path) -> str:
        read = _read(folder / file)
        size = np.ptp(read.mesh.verts_obj, axis=0)
        assert np.allclose(size, size_m, rtol=1e-3), f"{size} m instead of {size_m}"
        assert len(read.mesh.faces) == 12, f"{len(read.mesh.faces)} triangles instead of 12"
        said = f" ({'; '.join(read.notes)})" if read.notes else ""
        return f"{file}: box of {' x '.join(f'{1000 * side:.0f}' for side in size)} mm{said}"

    return check


def _every_box(pattern: str) -> Callable[[Path], str]:
    def check(folder: Path) -> str:
        files = sorted(folder.glob(pattern))
        assert files, f"no {pattern} in {folder}"
        return "; ".join(_box(file.name)(folder) for file in files)

    return check


def _refused(file: str, words: str) -> Callable[[Path], str]:
    def check(folder: Path) -> str:
        try:
            read_object(folder / file, REFERENCE_READING)
        except ObjectError as error:
            if words in error.problem:
                raise
            raise AssertionError(f"{error.problem!r} does not say {words!r}") from error
        raise AssertionError("is read")

    return check


def _green_and_grey(folder: Path) -> str:
    read = _read(folder / "green_and_grey.glb")
    samples = sample_surface(read.mesh, 4000, np.random.default_rng(0))
    left = samples.points_obj[:, 0] < 0
    grey = float(srgb_from_linear(np.array(0.2)))
    assert np.abs(samples.colors[left] - GREEN).max() < 0.01, "the left box is not green"
    assert np.abs(samples.colors[~left] - grey).max() < 0.01, "the right box is not grey"
    return "left green, right grey"


def _grey_ramp(folder: Path) -> str:
    """Columns of equal steps up to white: every tenth of the surface is a tenth brighter."""
    deciles = np.quantile(_colors(folder / "grey16_png.glb"), np.arange(0.1, 1.0, 0.1))
    assert np.abs(deciles - np.linspace(0.13, 0.89, 9)).max() < 0.04, f"deciles {deciles.round(2)}"
    return f"grey16_png.glb: deciles {deciles.round(2).tolist()}"


def _dithered(folder: Path) -> str:
    """The luminance of the chequered image as single black and white texels: 30 % of them are white."""
    linear = linear_from_srgb(_colors(folder / "one_bit_png.glb"))
    assert np.ptp(linear, axis=1).max() < 1e-6, "is not grey"
    share = float(linear.mean())
    assert abs(share - 0.3) < 0.03, f"{share:.0%} of white"
    return f"one_bit_png.glb: {share:.0%} of white"


def _mirrored(folder: Path) -> str:
    mesh = _read(folder / "mirrored.glb").mesh
    corners = mesh.verts_obj[mesh.faces]
    volume = float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)
    assert abs(volume - 480e-6) < 1e-7, f"volume {1e6 * volume:.1f} cm3 instead of 480"
    return f"one box of {1e6 * volume:.0f} cm3, outward"


def _three_boxes(folder: Path) -> str:
    mesh = _read(folder / "three.glb").mesh
    assert len(mesh.faces) == 36, f"{len(mesh.faces)} triangles instead of 36"
    return "three boxes"


CASES: tuple[Case, ...] = (
    Case(
        folder="g01_factor_times_white_vertex_colour",
        what="base colour factor times white COLOR_0",
        check=_one_color("red_box.glb", tuple(srgb_from_linear(np.array([0.6, 0.02, 0.02])).tolist())),
    ),
    Case(
        folder="g03_vertex_colour_on_one_of_two_primitives",
        what="COLOR_0 on one of two primitives",
        check=_green_and_grey,
    ),
    Case(
        folder="g04_texture_times_vertex_colour",
        what="texture times COLOR_0",
        check=_one_color("tinted.glb", tuple(srgb_from_linear(np.array([0.1, 0.4, 0.1])).tolist())),
    ),
    Case(folder="g05_clamp_to_edge", what="wrap modes of samplers", check=_palette("clamped.glb", QUADRANTS, CLAMPED)),
    Case(
        folder="g06_json_chunk_padded_with_nul", what="JSON chunk padded with NUL", check=_box("nul_padded.glb")
    ),
    *(
        Case(
            folder="g07_meshopt",
            what=f"meshopt without a plain copy ({suffix})",
            check=_refused(f"packed.{suffix}", "EXT_meshopt_compression"),
            refused_is_right=True,
        )
        for suffix in ("glb", "gltf")
    ),
    Case(
        folder="g08_basisu_with_png_fallback",
        what="KHR_texture_basisu with a PNG",
        check=_palette("with_fallback.glb", CHECKS, (0.5, 0.5)),
    ),
    Case(
        folder="g09_texture_transform_override",
        what="KHR_texture_transform with a UV set of its own",
        check=_palette("yellow.glb", QUADRANTS, (0, 0, 0, 1)),
    ),
    Case(folder="g10_quantised", what="KHR_mesh_quantization", check=_box("quantised.glb", (0.1, 0.1, 0.1))),
    Case(folder="g11_mirrored_node_second_scene", what="mirrored node, second scene", check=_mirrored),
    Case(
        folder="g12_names_with_spaces_and_unicode",
        what="names with spaces and umlauts",
        check=_palette("tasse ä.gltf", CHECKS, (0.5, 0.5)),
    ),
    *(
        Case(
            folder="g13_odd_textures", what=f"texture {kind}", check=_palette(f"{kind}.glb", palette, shares)
        )
        for palette, shares, kinds in (
            (CHECKS, (0.5, 0.5), ("bmp", "cmyk_jpeg", "exif_turned_jpeg", "gif", "palette_png")),
            (CHECKS, (0.5, 0.5), ("tga", "tiff", "webp_plain")),
            (GREY_CHECKS, (0.5, 0.5), ("grey_progressive_jpeg", "la_png")),
        )
        for kind in kinds
    ),
    Case(folder="g13_odd_textures", what="texture grey16_png", check=_grey_ramp),
    Case(folder="g13_odd_textures", what="texture one_bit_png", check=_dithered),
    Case(folder="g14_gpu_instancing", what="EXT_mesh_gpu_instancing", check=_three_boxes),
    Case(
        folder="g15_gltf1_binary",
        what="binary glTF 1.0",
        check=_refused("old.glb", "glTF 1.0"),
        refused_is_right=True,
    ),
    Case(
        folder="g16_unused_skin_and_still_animation",
        what="skin and animation of nothing that is drawn",
        check=_every_box("*.glb"),
    ),
    Case(folder="g18_data_uris", what="data URIs", check=_every_box("*.gltf")),
    Case(
        folder="g19_lines_points_and_triangles",
        what="points and lines beside triangles",
        check=_box("mixed.glb"),
    ),
    Case(
        folder="g20_baked_emissive",
        what="colours in the emissive texture alone",
        check=_palette("emissive_only.glb", CHECKS, (0.5, 0.5)),
    ),
    Case(
        folder="g21_required_but_harmless_extensions",
        what="required extensions that change no shape",
        check=_every_box("*.glb"),
    ),
    Case(folder="g22_zero_scale_extra_node", what="a part of no size far away", check=_box("hidden_part.glb")),
)  # fmt: skip
