"""Objects start where a table, or its edge, really holds them."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from datagen.grasps.synthesis.start_poses import START_KINDS, resting_poses, sample_start


def _starts(obj, config, count=60):
    poses = resting_poses(obj, np.zeros(3))
    rng = np.random.default_rng(0)
    trust = np.ones((len(poses.weight), len(START_KINDS)))
    return [sample_start(poses, trust, config, rng) for _ in range(count)]


@pytest.mark.parametrize("uid", ["can", "box", "plate", "comb"])
def test_resting_objects_touch_the_table_with_their_weight_above_it(uid, objects, config):
    for start in _starts(objects[uid], config):
        verts = objects[uid].mesh.verts_obj @ start.T_world_from_obj[:3, :3].T + start.T_world_from_obj[:3, 3]
        if start.kind == "held":
            assert verts[:, 2].min() > 0.1
            continue
        assert verts[:, 2].min() == pytest.approx(0.0, abs=1e-9)
        if start.kind == "edge":
            ahead = (verts[:, :2] - start.table_edge.point_xy_m) @ np.array(start.table_edge.outward_xy)
            assert ahead.max() > 0.01  # something to hold
            behind = np.array(start.table_edge.point_xy_m) @ np.array(start.table_edge.outward_xy)
            assert behind > 0.005  # the centre of mass (the origin) lies behind the edge


def test_flat_objects_mostly_overhang_and_tall_ones_stand(objects, config):
    kinds = [start.kind for start in _starts(objects["comb"], config)]
    assert kinds.count("edge") > kinds.count("table")
    kinds = [start.kind for start in _starts(objects["can"], config)]
    assert kinds.count("table") > 0.6 * len(kinds)


def test_a_ball_has_a_pose_too(config, make_object):
    ball = make_object("ball", trimesh.creation.icosphere(subdivisions=4, radius=0.03))
    assert len(_starts(ball, config, 5)) == 5


def test_no_allowed_start_is_an_error(objects, config):
    nothing = replace(config, table_start_weight=0.0, edge_start_weight=0.0, held_start_weight=0.0)
    with pytest.raises(ValueError, match="table_start_weight"):
        _starts(objects["can"], nothing, 1)
