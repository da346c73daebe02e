"""Closed and manifold whatever the decoder says; exact where the truth is known."""

import numpy as np
import pytest
import trimesh
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from model.errors import ModelError
from model.surface.extraction import ExtractionConfig, extract_surface
from model.surface.fields import SurfaceFields
from model.surface.lattice import corner_lattice
from model.surface.mesh import check_manifold
from model.surface.simplification import simplify, without_small_components
from model.surface.watertight_mesh import SurfaceExtractionConfig, extracted_surface
from tests.model.surface.shells import ball, grid, noise_fields, shell_fields, torus, union

SEALED = ExtractionConfig(seal=2)
OPEN = ExtractionConfig(seal=0)


def _watertight(mesh) -> bool:
    """The second opinion."""
    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return shape.is_watertight and shape.is_winding_consistent


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    resolution=st.integers(2, 9),
    deformation=st.sampled_from([0.0, 0.5, 20.0]),
    levels=st.sampled_from([None, 1]),
    seal=st.integers(0, 2),
)
def test_noise_is_manifold(seed, resolution, deformation, levels, seal) -> None:
    fields = noise_fields(seed, resolution=resolution, deformation=deformation, levels=levels)
    assume((corner_lattice(fields, margin=1).distances < 0).any())
    mesh = extract_surface(fields, ExtractionConfig(seal=seal)).mesh
    if deformation > 1.0:  # corners at their limits: cells overlap, and the volume may have any sign
        assert _watertight(mesh)
    else:
        assert check_manifold(mesh).volume > 0.0
        assert _watertight(mesh)


def test_every_pattern_of_two_neighbouring_cells_along_every_axis() -> None:
    """All 4096 sides of the 12 corners of two cubes, apart from each other in one grid, each along three axes."""
    patterns = (np.arange(4096)[:, None] >> np.arange(12) & 1).astype(bool).reshape(-1, 3, 2, 2)
    resolution = 96
    places = grid(24)[: 3 * 4096] * 4
    voxels, distances = [], []
    for axis in range(3):
        block = np.moveaxis(patterns, 1, 1 + axis)  # corners of this block, x y z
        for cell in (0, 1):
            start = np.zeros(3, dtype=int)
            start[axis] = cell
            voxels.append(places[4096 * axis : 4096 * (axis + 1)] + start)
            i, j, k = (start[:, None] + np.array([[c >> a & 1 for c in range(8)] for a in range(3)])).tolist()
            distances.append(np.where(block[:, i, j, k], -1.0, 1.0))
    n = sum(map(len, voxels))
    fields = SurfaceFields(
        resolution=resolution,
        voxels=np.concatenate(voxels),
        distances=np.concatenate(distances).astype(np.float32),
        deformations=np.zeros((n, 8, 3), dtype=np.float32),
        color_logits=np.zeros((n, 8, 3), dtype=np.float32),
    )
    mesh = extract_surface(fields, OPEN).mesh
    check_manifold(mesh)
    assert _watertight(mesh)
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_exact_zeros_make_no_flat_triangle(seed) -> None:
    fields = noise_fields(seed, resolution=6, deformation=0.0, levels=1)
    mesh = extract_surface(fields, OPEN).mesh
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 0.0
    assert len(np.unique(mesh.vertices, axis=0)) == len(mesh.vertices)


def test_volume_and_area_of_a_ball_converge_with_the_square_of_the_cell() -> None:
    radius, resolutions = 0.4, np.array([16, 32, 64, 128])
    errors = []
    for resolution in resolutions:
        fields = shell_fields(int(resolution), ball(radius), coarse=int(resolution) // 4)
        report = check_manifold(extract_surface(fields, SEALED).mesh)
        assert (report.components, report.genus) == (1, 0)
        errors.append(
            [
                abs(report.volume / (4 / 3 * np.pi * radius**3) - 1),
                abs(report.area / (4 * np.pi * radius**2) - 1),
            ]
        )
    slopes = np.polyfit(np.log(resolutions), np.log(errors), 1)[0]
    assert slopes[0] == pytest.approx(-2.0, abs=0.1)
    assert slopes[1] < -1.7
    assert np.all(np.array(errors[-1]) < 3e-4)


def test_vertices_lie_on_the_ball_and_carry_the_colour_of_their_place() -> None:
    mesh = extract_surface(shell_fields(64, ball(0.4), coarse=16), SEALED).mesh
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.4).max() < 2e-4
    np.testing.assert_allclose(mesh.colors, 1.0 / (1.0 + np.exp(-4.0 * mesh.vertices)), atol=2e-4)


def test_deformed_corners_change_the_cells_but_not_the_surface() -> None:
    """Distances taken where the corners have moved to: the same ball, from other cells."""
    plain = shell_fields(64, ball(0.4), coarse=16)
    rng = np.random.default_rng(0)
    by_corner = rng.normal(size=(65, 65, 65, 3)).astype(np.float32)
    corner = plain.voxels[:, None] + np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)])
    deformations = by_corner[tuple(np.moveaxis(corner, -1, 0))]
    moved = (corner + 0.5 * np.tanh(deformations)) / 64 - 0.5
    fields = SurfaceFields(
        resolution=64,
        voxels=plain.voxels,
        distances=ball(0.4)(moved).astype(np.float32),
        deformations=deformations,
        color_logits=plain.color_logits,
    )
    mesh = extract_surface(fields, SEALED).mesh
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.4).max() < 1.5e-3
    assert check_manifold(mesh).volume == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=3e-3)


def test_torus_and_two_components() -> None:
    report = check_manifold(extract_surface(shell_fields(64, torus(0.3, 0.1), coarse=16), SEALED).mesh)
    assert (report.components, report.genus) == (1, 1)
    assert report.volume == pytest.approx(2 * np.pi**2 * 0.3 * 0.1**2, rel=0.01)
    two = union(ball(0.2, (-0.25, 0, 0)), ball(0.1, (0.3, 0, 0)))
    mesh = extract_surface(shell_fields(64, two, coarse=16), SEALED).mesh
    assert check_manifold(mesh).components == 2
    large, dropped = without_small_components(mesh, 0.2)
    assert dropped == 1
    assert check_manifold(large).volume == pytest.approx(4 / 3 * np.pi * 0.2**3, rel=0.01)
    assert without_small_components(mesh, 0.05)[1] == 0


def test_a_shell_is_one_watertight_and_a_cavity_stays_where_the_shell_says_so() -> None:
    watertight = check_manifold(extract_surface(shell_fields(64, ball(0.4), coarse=16), OPEN).mesh)
    assert watertight.components == 1
    assert watertight.volume == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=2e-3)
    hollow = lambda points: np.abs(ball(0.3)(points)) - 0.1  # noqa: E731
    report = check_manifold(extract_surface(shell_fields(64, hollow, coarse=16), OPEN).mesh)
    assert report.components == 2
    assert report.volume == pytest.approx(4 / 3 * np.pi * (0.4**3 - 0.2**3), rel=3e-3)


def test_gaps_in_the_shell_are_sealed_and_counted() -> None:
    whole = 4 / 3 * np.pi * 0.4**3
    holed = shell_fields(64, ball(0.4), coarse=16, keep=0.8)
    sealed, leaking = extract_surface(holed, SEALED), extract_surface(holed, OPEN)
    assert check_manifold(sealed.mesh).volume == pytest.approx(whole, rel=0.01)
    assert check_manifold(leaking.mesh).volume < 0.5 * whole
    assert 0 < sealed.exposed_corners < leaking.exposed_corners
    assert sealed.uncolored_vertices > 0
    np.testing.assert_allclose(
        sealed.mesh.colors, 1.0 / (1.0 + np.exp(-4.0 * sealed.mesh.vertices)), atol=0.15
    )


def test_watertight_shapes_beyond_the_cube_end_at_its_sides() -> None:
    mesh = extract_surface(shell_fields(32, ball(0.7), coarse=8), SEALED).mesh
    check_manifold(mesh)
    assert np.abs(mesh.vertices).max() < 0.5 + 0.01 / 32


def test_nothing_inside_is_one_clear_line() -> None:
    fields = noise_fields(0, resolution=3, deformation=0.0)
    empty = SurfaceFields(
        resolution=3,
        voxels=fields.voxels,
        distances=np.abs(fields.distances),
        deformations=fields.deformations,
        color_logits=fields.color_logits,
    )
    with pytest.raises(ModelError, match=r"no corner of \d+ active voxels is inside"):
        extract_surface(empty, OPEN)


@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.1, 0.6, 0.9]))
def test_simplified_noise_stays_manifold(seed, share) -> None:
    """As many handles as noise has forbid few faces; then the limit on moves decides."""
    mesh = extract_surface(noise_fields(seed, resolution=8, deformation=0.5), OPEN).mesh
    mesh = without_small_components(mesh, 0.5)[0]
    wanted = int(share * len(mesh.faces))
    simple = simplify(mesh, wanted, max_move=0.05)
    assert len(simple.faces) < len(mesh.faces)
    check_manifold(simple)
    assert _watertight(simple)
    old = {(*place, *color) for place, color in zip(mesh.vertices.tolist(), mesh.colors.tolist())}
    assert {(*p, *c) for p, c in zip(simple.vertices.tolist(), simple.colors.tolist())} <= old


def test_simplification_stops_at_the_allowed_move() -> None:
    mesh = extract_surface(shell_fields(64, ball(0.4), coarse=16), SEALED).mesh
    simple = simplify(mesh, 100, max_move=1e-3)
    assert 100 < len(simple.faces) < len(mesh.faces) / 2
    corners = simple.vertices[simple.faces].mean(axis=1)
    assert np.abs(np.linalg.norm(corners, axis=1) - 0.4).max() < 2e-3
    assert simplify(mesh, len(mesh.faces), max_move=1e-3) is mesh


def test_watertight_surface_of_a_bumpy_torus() -> None:
    bumpy = lambda p: torus(0.3, 0.1)(p) + 0.004 * np.sin(150 * p[..., 0]) * np.sin(150 * p[..., 1])  # noqa: E731
    config = SurfaceExtractionConfig(
        extraction=SEALED, min_component_share=0.01, max_faces=8000, max_simplification_move=0.01
    )
    watertight = extracted_surface(shell_fields(64, bumpy, coarse=16), config)
    assert 0.8 * 8000 < watertight.report.faces <= 8000
    assert watertight.report.genus == 1
    assert watertight.report.volume == pytest.approx(2 * np.pi**2 * 0.3 * 0.1**2, rel=0.02)
    assert _watertight(watertight.mesh)
    np.testing.assert_allclose(
        watertight.mesh.colors, 1 / (1 + np.exp(-4.0 * watertight.mesh.vertices)), atol=1e-3
    )
