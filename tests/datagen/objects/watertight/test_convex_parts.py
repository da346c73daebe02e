"""Convex parts: they cover the watertight mesh, and their excess is what is recorded."""

import numpy as np
import pytest
import trimesh

from datagen.objects.watertight.convex_parts import ConvexConfig, convex_parts
from datagen.objects.watertight.preparation import (
    PreparationConfig,
    cached_watertight,
    make_watertight,
    watertight_from_bytes,
    watertight_to_bytes,
)
from datagen.objects.watertight.watertight_mesh import WatertightSurface, signed_distance, watertight_surface

CONFIG = ConvexConfig(
    thresholds=(0.05,),
    max_hulls=16,
    max_hull_verts=96,
    hull_tolerance_m=0.0002,
    max_excess_m=0.002,
    max_faces=2000,
    mcts_iterations=20,
    seed=0,
)


def surface_of(verts, faces) -> WatertightSurface:
    return WatertightSurface(verts_obj=np.array(verts), faces=np.array(faces), watertight_source=True)


def test_a_box_is_its_own_hull(box):
    parts, fit = convex_parts(surface_of(*box), CONFIG)
    assert len(parts) == 1
    assert len(parts[0].verts_obj) == 8
    assert fit.excess_max_m < 1e-6
    assert fit.uncovered_max_m < 1e-6


def test_round_hulls_keep_within_a_millimetre():
    ball = trimesh.creation.icosphere(4, 0.04)
    parts, fit = convex_parts(surface_of(ball.vertices, ball.faces), CONFIG)
    assert len(parts) == 1
    assert len(parts[0].verts_obj) <= CONFIG.max_hull_verts
    assert fit.uncovered_max_m < 2e-3
    assert fit.excess_max_m < 5e-4


def test_parts_of_a_cross_are_closed_convex_and_cover_it(crossing_boxes, watertight_config):
    surface = watertight_surface(*crossing_boxes, watertight_config, source="cross")
    parts, fit = convex_parts(surface, CONFIG)
    assert len(parts) > 1
    for part in parts:
        hull = trimesh.Trimesh(part.verts_obj, part.faces, process=False)
        assert hull.is_watertight
        assert hull.volume > 0
        assert hull.is_convex
    points, _ = trimesh.sample.sample_surface(
        trimesh.Trimesh(surface.verts_obj, surface.faces, process=False), 2000, seed=0
    )
    depth = np.min([signed_distance(p.verts_obj, p.faces, points) for p in parts], axis=0)
    assert depth.max() <= fit.uncovered_max_m + 3e-4
    assert fit.uncovered_max_m < 1e-3
    assert fit.excess_p99_m < 1e-3
    assert fit.excess_max_m < 4e-3


def test_same_watertight_same_parts(crossing_boxes, watertight_config):
    surface = watertight_surface(*crossing_boxes, watertight_config, source="cross")
    first, second = convex_parts(surface, CONFIG)[0], convex_parts(surface, CONFIG)[0]
    assert len(first) == len(second)
    for a, b in zip(first, second):
        np.testing.assert_array_equal(a.verts_obj, b.verts_obj)


@pytest.fixture
def preparation(watertight_config) -> PreparationConfig:
    return PreparationConfig(watertight=watertight_config, convex=CONFIG)


def test_watertight_survives_its_bytes(open_box, plain_mesh, preparation):
    watertight = make_watertight(plain_mesh(*open_box), preparation, source="open box")
    data = watertight_to_bytes(watertight)
    back = watertight_from_bytes(data)
    assert watertight_to_bytes(back) == data
    np.testing.assert_allclose(back.verts_obj, watertight.verts_obj, atol=1e-8)
    assert back.fit == watertight.fit
    assert back.fit.deviation_max_m < 2.5e-3
    assert len(back.parts) == len(watertight.parts) >= 5


def test_cache_gives_the_same_and_mends_itself(box, plain_mesh, preparation, tmp_path):
    first = cached_watertight(plain_mesh(*box), preparation, tmp_path, source="box")
    (entry,) = tmp_path.iterdir()
    again = cached_watertight(plain_mesh(*box), preparation, tmp_path, source="box")
    np.testing.assert_array_equal(first.verts_obj, again.verts_obj)
    data = entry.read_bytes()
    entry.write_bytes(data[: len(data) // 2])
    mended = cached_watertight(plain_mesh(*box), preparation, tmp_path, source="box")
    np.testing.assert_array_equal(first.verts_obj, mended.verts_obj)
    assert entry.read_bytes() == data
    cached_watertight(plain_mesh(box[0] * 2, box[1]), preparation, tmp_path, source="larger box")
    assert len(list(tmp_path.iterdir())) == 2
