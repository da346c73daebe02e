"""The libraries: what ships is complete, licensed and sound; folders load; bad uids are named."""

import zipfile
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
import trimesh

from datagen.objects.errors import ObjectError
from datagen.objects.mesh.graspable_size import HOLDABLE_SIDES_M, holdable_scale
from datagen.objects.stores.library import StarterPack, Sweethome3D

DATA = files("datagen.objects").joinpath("data")


@pytest.fixture(scope="module")
def pack() -> StarterPack:
    return StarterPack()


@pytest.fixture(scope="module")
def assets(pack):
    return [pack.load(uid) for uid in pack.uids()]


def test_there_are_forty_objects_or_more(pack):
    assert len(pack.uids()) >= 40
    assert pack.uids() == tuple(sorted(pack.uids()))
    assert all(uid.startswith("starter/") for uid in pack.uids())


def test_all_is_cc0_and_attributed(assets):
    page = DATA.joinpath("ATTRIBUTION.md").read_text(encoding="utf-8")
    for asset in assets:
        assert asset.licence == "CC0-1.0"
        assert asset.author
        assert "BlendSwap-CC-0" in asset.source
        assert f"| {asset.uid} | {asset.name} | {asset.author} | CC0-1.0 |" in page


def test_package_data_stays_small():
    size = sum(path.stat().st_size for path in Path(str(DATA)).rglob("*") if path.is_file())
    assert size <= 8.5e6


def test_watertight_shapes_are_closed_and_follow_what_is_drawn(assets):
    for asset in assets:
        watertight = trimesh.Trimesh(asset.watertight.verts_obj, asset.watertight.faces, process=False)
        assert watertight.is_watertight, asset.uid
        assert watertight.volume > 0, asset.uid
        assert asset.watertight.fit is not None
        assert asset.watertight.fit.deviation_mean_m < 1.5e-3, asset.uid
        extent = np.ptp(asset.mesh.verts_obj, axis=0)
        np.testing.assert_allclose(watertight.extents, extent, atol=2.5e-3, err_msg=asset.uid)


def test_convex_parts_are_sound(assets):
    for asset in assets:
        assert 1 <= len(asset.watertight.parts) <= 64, asset.uid
        for part in asset.watertight.parts:
            assert trimesh.Trimesh(part.verts_obj, part.faces, process=False).volume > 0, asset.uid


def test_sizes_are_metric_and_fit_a_hand(assets):
    for asset in assets:
        sides = np.sort(np.ptp(asset.mesh.verts_obj, axis=0))
        assert (sides <= np.array(HOLDABLE_SIDES_M) + 1e-4).all(), asset.uid
        assert sides[2] > 0.05, asset.uid
        assert 0 < asset.catalogue_scale <= 1
        np.testing.assert_allclose(
            asset.mesh.verts_obj.max(axis=0), -asset.mesh.verts_obj.min(axis=0), atol=1e-6
        )
    by_uid = {asset.uid: asset for asset in assets}
    np.testing.assert_allclose(
        np.ptp(by_uid["starter/phone"].mesh.verts_obj, axis=0), [0.058, 0.115, 0.009], atol=1e-4
    )


def test_textures_are_kept(assets):
    textured = [asset for asset in assets if asset.texture.texture_resolution_px > 0]
    assert len(textured) >= 12
    assert any(material.transmission > 0 for asset in assets for material in asset.mesh.materials)
    assert any(material.metallic > 0 for asset in assets for material in asset.mesh.materials)


def test_description_and_texture_agree_with_the_loaded_object(pack, assets):
    for asset in assets[:5]:
        assert pack.describe(asset.uid).licence == asset.licence
        assert pack.measure(asset.uid).texture == asset.texture
    with pytest.raises(ObjectError, match="has no object"):
        pack.describe("starter/moon")


def test_loading_is_deterministic(pack):
    first, second = pack.load("starter/milk"), StarterPack().load("starter/milk")
    np.testing.assert_array_equal(first.mesh.verts_obj, second.mesh.verts_obj)
    np.testing.assert_array_equal(first.watertight.verts_obj, second.watertight.verts_obj)
    assert first.mesh.materials == second.mesh.materials


def test_unknown_uid_is_named(pack):
    with pytest.raises(ObjectError, match="has no object 'starter/moon'"):
        pack.load("starter/moon")


@pytest.mark.parametrize(
    ("size_m", "scale"), [((0.05, 0.05, 0.2), 1.0), ((0.15, 0.15, 0.15), 0.5), ((0.01, 0.2, 0.4), 0.65)]
)
def test_miniature_rule(size_m, scale):
    assert holdable_scale(np.array(size_m)) == pytest.approx(scale)


def test_absent_debian_library_says_how_to_get_it(tmp_path, quick_preparation):
    with pytest.raises(ObjectError, match="apt-get install sweethome3d-furniture"):
        Sweethome3D(tmp_path, quick_preparation, tmp_path)


def test_debian_library_reads_catalogue_models(tmp_path, quick_preparation):
    """A library in miniature: Y-up model, rotation, catalogue size, fixtures and furniture left out."""
    box = trimesh.creation.box((1, 2, 3))
    entries = {
        1: ("Box", "m/box/box.obj", "10", "20", "30", "1 0 0 0 0 1 0 -1 0"),
        2: ("Sofa", "m/sofa/sofa.obj", "200", "90", "80", "1 0 0 0 1 0 0 0 1"),
        3: ("Wall plug", "m/plug/plug.obj", "8", "4", "8", "1 0 0 0 1 0 0 0 1"),
    }
    keys = ("name", "model", "width", "depth", "height", "modelRotation")
    lines = [
        f"{key}#{index}={'/' + value if key == 'model' else value}"
        for index, values in entries.items()
        for key, value in zip(keys, values)
    ]
    with zipfile.ZipFile(tmp_path / "BlendSwap-CC-0.sh3f", "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", "\n".join([*lines, "creator#1=Ann\\u00e9"]))
        for _, model, *_ in entries.values():
            archive.writestr(model, box.export(file_type="obj"))
    library = Sweethome3D(tmp_path, quick_preparation, tmp_path / "cache")
    assert library.uids() == ("sweethome3d/BlendSwap-CC-0/box",)
    asset = library.load(library.uids()[0])
    assert (asset.licence, asset.author) == ("CC0-1.0", "Anné")
    assert library.describe(asset.uid).licence == asset.licence
    assert library.measure(asset.uid).texture == asset.texture
    assert asset.catalogue_scale == pytest.approx(0.7)  # the middle side, 20 cm, is the limit
    np.testing.assert_allclose(np.ptp(asset.mesh.verts_obj, axis=0), [0.07, 0.14, 0.21], rtol=1e-6)
