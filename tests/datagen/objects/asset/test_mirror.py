"""Mirror images."""

import numpy as np
import pytest
import trimesh

from datagen.objects.asset.mirror import is_mirrored, mirrored_asset, mirrored_uid, unmirrored_uid
from datagen.objects.mesh.surface_points import colors_at, face_normals
from datagen.objects.stores.library import StarterPack
from shards.splits import object_identity


@pytest.fixture(scope="module")
def rock():
    return StarterPack().load("starter/rock_a")


@pytest.mark.parametrize(
    ("uid", "mirrored"),
    [
        ("a/b", "a/b@mirrored"),
        ("a/b@large", "a/b@large-mirrored"),
        ("a/mirrored", "a/mirrored@mirrored"),
        ("batch@1/b", "batch@1/b@mirrored"),
        ("batch@1/b-mirrored", "batch@1/b-mirrored@mirrored"),
        ("batch@mirrored/b", "batch@mirrored/b@mirrored"),
    ],
)
def test_uids(uid, mirrored):
    assert mirrored_uid(uid) == mirrored
    assert object_identity(mirrored) == object_identity(uid)
    assert is_mirrored(mirrored)
    assert not is_mirrored(uid)
    assert unmirrored_uid(mirrored) == uid == unmirrored_uid(uid)


def test_mirror_image_is_the_same_thing_seen_in_a_mirror(rock):
    image = mirrored_asset(rock)
    flip = np.array([-1.0, 1.0, 1.0])
    np.testing.assert_array_equal(image.mesh.verts_obj, rock.mesh.verts_obj * flip)
    np.testing.assert_allclose(  # outward stays outward
        face_normals(image.mesh.verts_obj, image.mesh.faces),
        face_normals(rock.mesh.verts_obj, rock.mesh.faces) * flip,
        atol=1e-12,
    )
    surfaces = [(shape.verts_obj, shape.faces) for shape in image.watertight.parts]
    for verts, faces in [(image.watertight.verts_obj, image.watertight.faces), *surfaces]:
        assert trimesh.Trimesh(verts, faces, process=False).volume > 0
    face = np.arange(len(rock.mesh.faces))
    weights = np.tile([0.7, 0.2, 0.1], (len(face), 1))
    np.testing.assert_allclose(
        colors_at(image.mesh, face, weights[:, ::-1]), colors_at(rock.mesh, face, weights), atol=1e-9
    )


def test_transform_leads_from_the_file_to_the_mirror_image(rock):
    image = mirrored_asset(rock)
    file_point = np.array([0.01, 0.02, 0.03, 1.0])
    there = rock.T_obj_from_file @ file_point
    np.testing.assert_array_equal(image.T_obj_from_file @ file_point, there * [-1, 1, 1, 1])


def test_twice_mirrored_is_the_original(rock):
    twice = mirrored_asset(mirrored_asset(rock))
    assert twice.uid == rock.uid
    assert twice.mesh.materials == rock.mesh.materials
    for name in ("verts_obj", "faces", "corner_uv", "face_material"):
        np.testing.assert_array_equal(getattr(twice.mesh, name), getattr(rock.mesh, name))
    np.testing.assert_array_equal(twice.watertight.verts_obj, rock.watertight.verts_obj)
    np.testing.assert_array_equal(twice.watertight.faces, rock.watertight.faces)
    for part, original in zip(twice.watertight.parts, rock.watertight.parts, strict=True):
        np.testing.assert_array_equal(part.verts_obj, original.verts_obj)
        np.testing.assert_array_equal(part.faces, original.faces)
    np.testing.assert_array_equal(twice.T_obj_from_file, rock.T_obj_from_file)
