"""A store as the package `objaverse` leaves it on disk."""

import gc

import numpy as np
import pytest

from datagen.objects.errors import ObjectError
from datagen.objects.mesh.graspable_size import HOLDABLE_SIDES_M
from datagen.objects.stores.library import REFERENCE_READING, ObjectLibrary
from datagen.objects.stores.objaverse import ObjaverseStore, objaverse_root
from datagen.objects.watertight.preparation import PreparationConfig
from tests.datagen.objects.official_files import MODELS, objaverse_id, write_gz, write_objaverse_store

BREAD = objaverse_id("starter/bread")


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_objaverse_store(tmp_path_factory.mktemp("store") / "hf-objaverse-v1")


@pytest.fixture
def opened(quick_preparation: PreparationConfig, tmp_path):
    def make(root) -> ObjaverseStore:
        return ObjaverseStore(root, REFERENCE_READING, quick_preparation, tmp_path / "cache")

    return make


def test_what_is_on_disk_is_listed(opened, root):
    store = opened(root)
    assert isinstance(store, ObjectLibrary)
    assert store.uids() == tuple(sorted(f"objaverse/{objaverse_id(name)}" for name in MODELS))
    assert opened(root).holds(f"objaverse/{BREAD}")
    assert not opened(root).holds("objaverse/" + "0" * 32)


def test_model_is_scaled_to_what_a_hand_holds(opened, root):
    asset = opened(root).load(f"objaverse/{BREAD}")
    sides = np.sort(np.ptp(asset.mesh.verts_obj, axis=0))
    assert (sides <= np.array(HOLDABLE_SIDES_M) + 1e-9).all()
    assert (sides / HOLDABLE_SIDES_M).max() == pytest.approx(1)
    file_longest = 10 * 0.2057  # the store's GLBs are ten times the starter object
    assert sides[2] / asset.catalogue_scale == pytest.approx(file_longest, rel=1e-3)
    assert (asset.licence, asset.author, asset.name) == ("CC-BY-4.0", "Ann Modeller", "Bread")
    assert asset.url == f"https://sketchfab.com/3d-models/{BREAD}"
    assert asset.texture.texture_resolution_px > 100
    np.testing.assert_allclose(
        np.linalg.det(asset.T_obj_from_file[:3, :3]), asset.catalogue_scale**3, rtol=1e-9
    )


def test_annotation(opened, root):
    note = opened(root).annotation(f"objaverse/{BREAD}")
    assert note is not None
    assert (note.name, note.licence, note.author) == ("Bread", "CC-BY-4.0", "Ann Modeller")
    assert (note.animation_count, note.texture_count, note.texture_max_resolution_px) == (0, 1, 512)
    assert (note.age_restricted, note.category) == (False, "bread")


def test_records_may_say_little(opened, root, tmp_path):
    copy = write_objaverse_store(tmp_path / "s", MODELS[:1], metadata=False)
    assert opened(copy).annotation(BREAD) is None
    write_gz(copy / "metadata" / "000-000.json.gz", {BREAD: {"uid": BREAD, "user": {"username": "ann"}}})
    note = opened(copy).annotation(BREAD)
    assert (note.name, note.licence, note.author, note.url) == (None, "NOASSERTION", "ann", None)
    assert (note.animation_count, note.face_count, note.age_restricted, note.category) == (None,) * 4
    asset = opened(copy).load(f"objaverse/{BREAD}")
    assert (asset.name, asset.licence, asset.author) == (BREAD, "NOASSERTION", "ann")


def test_annotation_of_a_model_that_is_not_on_disk(opened, tmp_path):
    root = write_objaverse_store(tmp_path / "s")
    (root / "glbs" / "000-000" / f"{BREAD}.glb").unlink()
    assert opened(root).annotation(BREAD).name == "Bread"
    with pytest.raises(ObjectError, match=r"has no object .*: it is not downloaded"):
        opened(root).load(f"objaverse/{BREAD}")


def test_partly_downloaded_model_is_named(opened, tmp_path):
    root = write_objaverse_store(tmp_path / "s")
    path = root / "glbs" / "000-000" / f"{BREAD}.glb"
    path.rename(path.with_name(path.name + ".tmp"))
    store = opened(root)
    assert f"objaverse/{BREAD}" not in store.uids()
    with pytest.raises(ObjectError, match="is only partly downloaded"):
        store.load(f"objaverse/{BREAD}")


@pytest.mark.parametrize("damage", [b"not gzip", b"\x1f\x8b\x08\x00cut", b""])
def test_damaged_metadata_are_named(opened, tmp_path, damage):
    root = write_objaverse_store(tmp_path / "s", MODELS[:1])
    (root / "metadata" / "000-000.json.gz").write_bytes(damage)
    with pytest.raises(ObjectError, match=r"000-000\.json\.gz: cannot be unpacked") as caught:
        opened(root).annotation(BREAD)
    assert "\n" not in str(caught.value)


MALFORMED = {
    "record": (lambda r: [1], r"is \[1\]"),
    "user": (lambda r: {**r, "user": "ann"}, "has user = 'ann'"),
    "user name": (lambda r: {**r, "user": {"displayName": 3}}, "has user.displayName = 3"),
    "license": (lambda r: {**r, "license": {"slug": "by"}}, "has license = "),
    "archives": (lambda r: {**r, "archives": [1]}, "has archives = "),
    "glb": (lambda r: {**r, "archives": {"glb": []}}, "has archives.glb = "),
    "faces": (lambda r: {**r, "faceCount": "12"}, "has faceCount = '12'"),
    "truth": (lambda r: {**r, "faceCount": True}, "has faceCount = True"),
    "age": (lambda r: {**r, "isAgeRestricted": "no"}, "has isAgeRestricted = 'no'"),
}


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_record_is_named_and_spoils_no_other(opened, tmp_path, case):
    spoil, problem = MALFORMED[case]
    root = write_objaverse_store(tmp_path / "s", MODELS[:1])
    other = {"uid": "other", "name": "Other"}
    good = {"uid": BREAD, "user": {"username": "ann"}}
    write_gz(root / "metadata" / "000-000.json.gz", {BREAD: spoil(good), "other": other})
    write_gz(root / "object-paths.json.gz", {BREAD: "glbs/000-000/a.glb", "other": "glbs/000-000/b.glb"})
    store = opened(root)
    for ask in (store.annotation, store.describe, store.load, store.annotation):
        with pytest.raises(
            ObjectError, match=rf"000-000\.json\.gz: the record of {BREAD} {problem}"
        ) as caught:
            ask(f"objaverse/{BREAD}")
        assert "\n" not in str(caught.value)
    assert store.annotation("other").name == "Other"


@pytest.mark.parametrize("content", [{BREAD: 1}, {BREAD: ["glbs"]}])
def test_malformed_paths_are_named(opened, tmp_path, content):
    root = write_objaverse_store(tmp_path / "s", MODELS[:1])
    write_gz(root / "object-paths.json.gz", content)
    with pytest.raises(ObjectError, match=rf"object-paths\.json\.gz: has .* for {BREAD}"):
        opened(root).load(BREAD)


@pytest.mark.parametrize("content", [{"bread": None}, {"bread": "abc"}, {"bread": [[1]]}])
def test_malformed_categories_are_named(opened, tmp_path, content):
    root = write_objaverse_store(tmp_path / "s", MODELS[:1])
    write_gz(root / "lvis-annotations.json.gz", content)
    with pytest.raises(ObjectError, match=r"lvis-annotations\.json\.gz: has .* for 'bread'"):
        opened(root).annotation(BREAD)


def test_model_is_found_by_its_path_without_listing(opened, root, monkeypatch):
    store = opened(root)
    with monkeypatch.context() as patch:
        patch.setattr("os.scandir", lambda _: pytest.fail("a folder is listed"))
        assert store.holds(BREAD)
        assert store.glb_path(BREAD).is_file()
        assert store.describe(BREAD).licence == "CC-BY-4.0"
    assert sorted(store.walk()) == list(store.uids())


def test_model_elsewhere_than_its_path_is_found_by_listing(opened, tmp_path):
    root = write_objaverse_store(tmp_path / "s")
    (root / "glbs" / "000-007").mkdir()
    moved = root / "glbs" / "000-007" / f"{BREAD}.glb"
    (root / "glbs" / "000-000" / f"{BREAD}.glb").rename(moved)
    assert opened(root).glb_path(BREAD) == moved


def test_records_are_not_kept(opened, tmp_path):
    """They are large; malformed ones, whose errors are kept, are no exception."""
    root = write_objaverse_store(tmp_path / "s", MODELS[:1])
    marked = {BREAD: {"name": "Bread", "mark": ["a"]}, "bad": {"mark": ["b"], "user": 1}}
    write_gz(root / "metadata" / "000-000.json.gz", marked)
    store = opened(root)
    assert store.annotation(BREAD).name == "Bread"
    gc.collect()
    found = [thing for thing in gc.get_objects() if type(thing) is dict and "mark" in thing]
    ours = {id(record) for record in marked.values()}
    assert {id(thing) for thing in found if thing["mark"] in (["a"], ["b"])} == ours


def test_root_comes_from_the_argument_the_environment_or_the_default(opened, root, tmp_path, monkeypatch):
    monkeypatch.setenv("OBJAVERSE", str(root))
    assert opened(None).root == root
    with pytest.raises(ObjectError, match="chosen by the path in the configuration"):
        opened(tmp_path / "none")
    monkeypatch.setenv("OBJAVERSE", str(tmp_path))
    with pytest.raises(ObjectError, match=r"holds no folder `glbs` \(chosen by \$OBJAVERSE\)"):
        opened(None)
    monkeypatch.delenv("OBJAVERSE")
    monkeypatch.setenv("HOME", str(root.parent))
    with pytest.raises(ObjectError, match=r"the default, as \$OBJAVERSE is not set"):
        opened(None)
    assert opened(root.parent).root == root  # the folder above is understood


def test_store_without_models_is_refused(opened, tmp_path):
    (tmp_path / "s" / "glbs" / "000-000").mkdir(parents=True)
    with pytest.raises(ObjectError, match="holds no models"):
        opened(tmp_path / "s")


def test_description_and_texture_agree_with_the_loaded_object(opened, root):
    store, uid = opened(root), f"objaverse/{BREAD}"
    asset = store.load(uid)
    assert store.describe(uid).licence == asset.licence
    assert store.describe(uid).annotation == store.annotation(uid)
    assert store.measure(uid).texture == asset.texture
    with pytest.raises(ObjectError, match="has no object"):
        store.describe("objaverse/none")


def test_root_need_not_exist_to_be_named(tmp_path, monkeypatch):
    monkeypatch.setenv("OBJAVERSE", str(tmp_path / "none"))
    assert objaverse_root(None) == tmp_path / "none"
    assert objaverse_root(tmp_path) == tmp_path
