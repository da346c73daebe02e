"""Files that are one object by their names get one uid, all others one of their own."""

import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.objects.asset.mirror import is_mirrored, mirrored_uid, unmirrored_uid
from datagen.objects.catalogue.folder_layouts import drawn_uid, layout_rank, object_uid_of_file, variant_of
from shards.splits import object_identity

HEX = "0123456789abcdef" * 2


@pytest.mark.parametrize(
    ("uid", "places"),
    [
        (
            "folder/ycb/003_cracker_box",
            [
                *(
                    f"ycb/003_cracker_box/{source}/{file}"
                    for source in ("google_16k", "google_64k", "google_512k", "poisson", "tsdf")
                    for file in ("textured.obj", "nontextured.ply", "nontextured.stl")
                ),
                "ycb/003_cracker_box/clouds/merged_cloud.ply",
                "ycb/003_cracker_box/google_16k/003_cracker_box.obj",
                "ycb/003_cracker_box/textured.obj",
                "ycb/003_cracker_box/textured_simple.obj",
                "ycb/003_cracker_box.glb",
            ],
        ),
        (
            "folder/ycbv/obj_000001",
            [
                *(f"ycbv/{folder}/obj_000001.ply" for folder in ("models", "models_eval", "models_fine", "models_cad")),
                "ycbv/object_models_eval/obj_000001.glb",
            ],
        ),
        (
            f"objaverse/{HEX}",
            [
                f"{HEX}.glb", f"obj/{HEX}.obj", f"large/{HEX}/{HEX}.obj",
                f"a/{HEX}_decimated.ply", f"a/{HEX}/model.obj",
            ],
        ),
        ("folder/a/mug", ["a/mug.glb", "a/mug.STL", "a/obj/mug.obj", "a/PLY/mug.ply"]),
        ("folder/batch@1/cup%40home", ["batch@1/cup@home.glb"]),
        ("folder/50%25", ["50%.glb"]),
        ("folder/two%0Alines", ["two\nlines.glb"]),
        ("folder/not%FFutf", ["not\udcffutf.glb"]),
        ("folder/é", [unicodedata.normalize("NFC", "é.glb"), unicodedata.normalize("NFD", "é.glb")]),
        ("folder/things", ["textured.obj", "google_16k/nontextured.stl"]),
    ],
)  # fmt: skip
def test_one_object(uid, places):
    assert {object_uid_of_file(place, "things") for place in places} == {uid}


def test_other_objects():
    places = [
        "a/mug.glb", "b/mug.glb", "mug.glb", "mug_2.glb", "obj_000001.ply", "models/obj_000002.ply",
        "obj/stl.ply", "clouds/grey.glb", "clouds/white.glb",
        f"{HEX}/handle.obj", f"{HEX}/cup.obj", f"{'0' * 40}/cup.obj",
    ]  # fmt: skip
    assert len({object_uid_of_file(place, "things") for place in places}) == len(places)


@given(
    st.text(st.characters(exclude_characters="/\x00", exclude_categories=())), st.sampled_from(["", "a/b@c/"])
)
def test_no_file_name_makes_a_variant_or_breaks_a_uid(name, folder):
    uid = object_uid_of_file(f"{folder}x{name}.glb", "things")
    uid.encode("utf-8")
    assert uid.isprintable()
    assert object_identity(uid) == uid
    assert not is_mirrored(uid)
    variant = variant_of("folder/first", uid)
    assert object_identity(variant) == "folder/first"
    assert not is_mirrored(variant)
    assert unmirrored_uid(mirrored_uid(variant)) == variant
    assert drawn_uid(variant) == uid
    assert drawn_uid(uid) == uid


def test_uids_of_other_sources_are_drawn_as_they_are():
    for uid in ("starter/milk", "starter/milk@mirrored", f"objaverse/{HEX}@large-mirrored"):
        assert drawn_uid(uid) == uid


def test_what_comes_first():
    places = [
        "x/google_16k/textured.obj", "x/google_64k/textured.obj", "x/poisson/textured.obj",
        "x/google_16k/nontextured.ply", "x/google_16k/nontextured.stl",
    ]  # fmt: skip
    assert sorted([*places[3:], *places[:3]], key=layout_rank) == places
    bop = ["m/models/obj_000001.ply", "m/models_fine/obj_000001.ply", "m/models_eval/obj_000001.ply"]
    assert sorted([*bop[1:], bop[0]], key=layout_rank) == bop
