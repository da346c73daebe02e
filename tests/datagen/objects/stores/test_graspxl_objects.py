"""GraspXL's object_dataset, with and without the textured originals."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from datagen.objects.asset.mirror import mirrored_asset
from datagen.objects.errors import ObjectError
from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.plain_look import LOOKS, with_plain_look
from datagen.objects.mesh.registration import REFERENCE_REGISTRATION
from datagen.objects.mesh.surface_points import sample_surface
from datagen.objects.stores.graspxl_objects import GraspXLObjects
from datagen.objects.stores.library import REFERENCE_READING, ObjectLibrary
from datagen.objects.stores.objaverse import ObjaverseStore
from datagen.objects.watertight.preparation import make_watertight, watertight_from_bytes, watertight_to_bytes
from tests.datagen.grasps.recorded.graspxl_sample import SAMPLE, needs_sample
from tests.datagen.objects.official_files import (
    MODELS,
    folder_of,
    objaverse_id,
    write_graspxl_objects,
    write_objaverse_store,
)

BREAD = objaverse_id("starter/bread")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_graspxl_objects(tmp_path_factory.mktemp("graspxl"), sizes=("small", "large"))


@pytest.fixture(scope="module")
def store_root(tmp_path_factory):
    return write_objaverse_store(tmp_path_factory.mktemp("store"))


@pytest.fixture
def opened(quick_preparation, tmp_path):
    def make(root, store_root=None, textures="when_present") -> GraspXLObjects:
        cache = tmp_path / "cache"
        store = store_root and ObjaverseStore(store_root, REFERENCE_READING, quick_preparation, cache)
        return GraspXLObjects(
            root,
            store,
            textures=textures,
            reading=REFERENCE_READING,
            preparation=quick_preparation,
            registration=REFERENCE_REGISTRATION,
            cache_dir=cache,
        )

    return make


def test_objects_are_listed_by_size(opened, root):
    library = opened(root)
    assert isinstance(library, ObjectLibrary)
    assert len(library.uids()) == 2 * len(MODELS)
    assert f"objaverse/{BREAD}@small" in library.uids()
    assert [uid.partition("@")[2] for uid in library.uids()] == ["small"] * 3 + ["large"] * 3


@pytest.mark.parametrize("above", ["", "dataset_example", "object_dataset"])
def test_root_may_be_above_or_below(opened, root, tmp_path, above):
    """As published, inside dataset_example, unzipped into a folder of its own name, or the folder itself."""
    moved = tmp_path / "data" / above
    moved.mkdir(parents=True)
    (moved / "object_dataset").symlink_to(root / "object_dataset")
    assert opened(tmp_path / "data").uids() == opened(root).uids()
    assert opened(root / "object_dataset").uids() == opened(root).uids()


def test_untextured_object_stays_in_the_frame_of_the_poses(opened, root):
    asset = opened(root).load(f"objaverse/{BREAD}@large")
    file = trimesh.load_mesh(root / "object_dataset" / "large" / BREAD / f"{BREAD}.obj", process=False)
    np.testing.assert_allclose(asset.T_obj_from_file[:3, :3], np.eye(3))
    there = file.vertices @ asset.T_obj_from_file[:3, :3].T + asset.T_obj_from_file[:3, 3]
    np.testing.assert_allclose(
        np.sort(asset.mesh.verts_obj, axis=0), np.sort(np.unique(there, axis=0), axis=0), atol=1e-9
    )
    assert np.ptp(asset.mesh.verts_obj, axis=0).min() == pytest.approx(0.075, rel=1e-5)
    assert (asset.licence, asset.source, asset.appearance) == ("CC-BY-NC-4.0", "graspxl", "generated")
    assert asset.texture.texture_resolution_px == 0
    assert asset.registration is None
    assert asset.watertight.parts == ()
    assert asset.watertight.fit is not None
    assert np.isnan(asset.watertight.fit.hull_excess_max_m)


def test_textured_original_is_drawn_in_place(opened, root, store_root):
    plain = opened(root).load(f"objaverse/{BREAD}@large")
    asset = opened(root, store_root).load(f"objaverse/{BREAD}@large")
    assert asset.registration is not None
    assert asset.registration.residual < 1e-4
    np.testing.assert_allclose(  # the same place, size and frame
        np.sort(asset.mesh.verts_obj, axis=0)[[0, -1]],
        np.sort(plain.mesh.verts_obj, axis=0)[[0, -1]],
        atol=1e-5,
    )
    np.testing.assert_array_equal(asset.T_obj_from_file, plain.T_obj_from_file)
    assert asset.texture.texture_resolution_px > 100
    assert (asset.licence, asset.author, asset.name) == ("CC-BY-4.0", "Ann Modeller", "Bread")
    assert (asset.source, asset.appearance) == ("objaverse", "original")


def test_description_and_texture_agree_with_the_loaded_object(opened, root, store_root):
    uid = f"objaverse/{BREAD}@large"
    for library in (opened(root), opened(root, store_root), opened(root, store_root, "none")):
        asset, described = library.load(uid), library.describe(uid)
        assert described.licence == asset.licence
        assert described.appearance == asset.appearance
        assert (described.annotation is None) == (library.describe(uid).licences == ("CC-BY-NC-4.0",))
        assert library.measure(uid).texture == asset.texture


def test_mirrored_textured_object_keeps_its_registration_consistent(opened, root, store_root):
    asset = opened(root, store_root).load(f"objaverse/{BREAD}@large")
    image = mirrored_asset(asset)
    assert image.uid == f"objaverse/{BREAD}@large-mirrored"
    T = image.registration.T_rescaled_from_original
    np.testing.assert_array_equal(T[0], -asset.registration.T_rescaled_from_original[0])
    twice = mirrored_asset(image).registration.T_rescaled_from_original
    np.testing.assert_array_equal(twice, asset.registration.T_rescaled_from_original)


def assert_derived(library: GraspXLObjects, uid: str) -> None:
    asset, described = library.load(uid), library.describe(uid)
    assert (asset.registration, asset.source, asset.appearance) == (None, "graspxl", "generated")
    assert (asset.name, asset.licence) == ("Bread", "CC-BY-NC-4.0 AND CC-BY-4.0")
    assert asset.author.startswith("Ann Modeller; mesh: Zhang, Christen")
    assert asset.url == f"https://sketchfab.com/3d-models/{BREAD}"
    assert described.licences == ("CC-BY-NC-4.0", "CC-BY-4.0")
    assert (described.annotation.name, described.appearance) == ("Bread", "generated")


def test_bare_mesh_derives_from_the_model(opened, root, store_root, tmp_path):
    """With textures left alone, and where only the metadata are on disk."""
    uid = f"objaverse/{BREAD}@small"
    assert_derived(opened(root, store_root, "none"), uid)
    bare = write_objaverse_store(tmp_path / "bare")
    (bare / "glbs" / folder_of(0) / f"{BREAD}.glb").unlink()
    assert_derived(opened(root, bare), uid)


@pytest.mark.parametrize(
    ("slug", "licence"),
    [
        ("by-nc", "CC-BY-NC-4.0"),
        ("by-nd", "CC-BY-NC-4.0 AND CC-BY-ND-4.0"),
        (None, "CC-BY-NC-4.0 AND NOASSERTION"),
    ],
)
def test_licence_of_a_bare_mesh_names_each_part_once(opened, root, tmp_path, slug, licence):
    store = write_objaverse_store(tmp_path / "s", licences=(slug,))
    uid = f"objaverse/{BREAD}@small"
    assert opened(root, store, "none").describe(uid).licence == licence
    (store / "metadata" / f"{folder_of(0)}.json.gz").unlink()
    assert opened(root, store, "none").describe(uid).licence == "CC-BY-NC-4.0"


def test_textures_required(opened, root, tmp_path):
    with pytest.raises(ObjectError, match="there is no Objaverse store"):
        opened(root, None, "required")
    some = write_objaverse_store(tmp_path / "some", MODELS[:1])
    library = opened(root, some, "required")
    assert library.uids() == opened(root).uids()
    assert library.load(f"objaverse/{BREAD}@large").registration is not None
    absent = f"objaverse/{objaverse_id('starter/rock_a')}@large"
    for ask in (library.describe, library.measure, library.load):
        with pytest.raises(ObjectError, match="has no object"):
            ask(absent)
    other = write_objaverse_store(tmp_path / "other", ("starter/milk",))
    with pytest.raises(ObjectError, match="holds the textured model of none"):
        opened(root, other, "required")


def test_required_model_that_is_not_downloaded_is_named(opened, root, tmp_path):
    store = write_objaverse_store(tmp_path / "s")
    glb = store / "glbs" / folder_of(0) / f"{BREAD}.glb"
    part = glb.rename(glb.with_name(f"{BREAD}.glb.tmp"))
    for problem in ("is only partly downloaded", "has no object .*: it is not downloaded"):
        library = opened(root, store, "required")
        for ask in (library.describe, library.measure, library.load):
            with pytest.raises(ObjectError, match=problem):
                ask(f"objaverse/{BREAD}@large")
        part.unlink(missing_ok=True)


def test_one_object_is_found_without_listing_the_others(opened, root, store_root, monkeypatch):
    library = opened(root, store_root, "required")
    monkeypatch.setattr("os.scandir", lambda _: pytest.fail("a folder is listed"))
    assert library.load(f"objaverse/{BREAD}@large").registration is not None
    assert library.describe(f"objaverse/{BREAD}@small").licence == "CC-BY-4.0"


def test_construction_looks_at_a_few_meshes_only(opened, root, tmp_path, monkeypatch):
    for k in range(50):
        path = tmp_path / "g" / "large" / f"{k:032x}" / f"{k:032x}.obj"
        path.parent.mkdir(parents=True)
        path.touch()
    asked = []
    is_file = Path.is_file

    def counted(path: Path) -> bool:
        asked.append(path)
        return is_file(path)

    monkeypatch.setattr(Path, "is_file", counted)
    library = opened(tmp_path / "g")
    assert len(asked) < 5
    assert len(library.uids()) == 50


def test_model_of_another_object_is_refused(opened, root, tmp_path):
    store = write_objaverse_store(tmp_path / "s", ("starter/rock_b", "starter/bread"))
    rock = store / "glbs" / "000-000" / f"{objaverse_id('starter/rock_b')}.glb"
    rock.rename(rock.with_name(f"{objaverse_id('starter/rock_a')}.glb"))
    uid = f"objaverse/{objaverse_id('starter/rock_a')}@large"
    with pytest.raises(ObjectError, match=r"\.glb: (does not match|has other proportions)"):
        opened(root, store).load(uid)


def test_wrong_places_are_named(opened, tmp_path, monkeypatch):
    monkeypatch.delenv("GRASPXL", raising=False)
    with pytest.raises(ObjectError, match="neither a path nor"):
        opened(None)
    with pytest.raises(ObjectError, match="is not a folder"):
        opened(tmp_path / "none")
    with pytest.raises(ObjectError, match="holds no GraspXL objects"):
        opened(tmp_path)
    (tmp_path / "large" / "abc").mkdir(parents=True)  # motions, not meshes
    with pytest.raises(ObjectError, match=r"holds no <id>/<id>\.obj"):
        opened(tmp_path)


@pytest.mark.parametrize(
    "uid", ["objaverse/x@large", "x", "objaverse/../large@large", f"objaverse/{BREAD}@huge"]
)
def test_unknown_uid_is_named(opened, root, uid):
    with pytest.raises(ObjectError, match=f"there is no object '{uid}'"):
        opened(root).load(uid)


def test_watertight_without_parts_keeps_its_bytes(box, plain_mesh, quick_preparation):
    watertight = make_watertight(plain_mesh(*box), quick_preparation, source="box", with_parts=False)
    data = watertight_to_bytes(watertight)
    again = watertight_from_bytes(data)
    assert again.parts == ()
    assert watertight_to_bytes(again) == data


def test_looks_differ_by_name_and_stay_for_one(box, plain_mesh):
    mesh: ObjectMesh = plain_mesh(*box)
    dressed = [with_plain_look(mesh, f"object {k}") for k in range(60)]
    assert len({one.materials[0].name for one in dressed}) == len(LOOKS)
    assert with_plain_look(mesh, "object 3").materials == dressed[3].materials
    for one in dressed:
        material = one.materials[0]
        colors = sample_surface(one, 200, np.random.default_rng(0)).colors
        assert 0.02 < colors.mean() < 0.98
        assert 0.05 < material.roughness < 1
        assert np.isfinite(one.corner_uv).all()


@needs_sample
def test_published_sample_loads(tmp_path, quick_preparation, monkeypatch):
    """Every real mesh, with watertight meshes (and metrics of their fit) coarse enough for seconds."""
    monkeypatch.setattr("datagen.objects.watertight.preparation.N_DEVIATION_POINTS", 1000)
    coarse = replace(
        quick_preparation.watertight,
        level_set=replace(quick_preparation.watertight.level_set, voxels_longest=40),
    )
    library = GraspXLObjects(
        SAMPLE,
        None,
        textures="none",
        reading=REFERENCE_READING,
        preparation=replace(quick_preparation, watertight=coarse),
        registration=REFERENCE_REGISTRATION,
        cache_dir=tmp_path,
    )
    assert len(library.uids()) >= 20
    for uid in library.uids()[:20]:
        asset = library.load(uid)
        sides = np.ptp(asset.mesh.verts_obj, axis=0)
        assert 0.06 < sides.min() < 0.09
        np.testing.assert_allclose(asset.T_obj_from_file[:3, :3], np.eye(3))
        assert np.abs(asset.T_obj_from_file[:3, 3]).max() < 1e-4  # published meshes are centred
        assert trimesh.Trimesh(
            asset.watertight.verts_obj, asset.watertight.faces, process=False
        ).is_watertight
