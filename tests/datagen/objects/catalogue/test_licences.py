"""Licence names."""

import pytest

from datagen.objects.catalogue.description import ObjectDescription
from datagen.objects.catalogue.licences import joined_licences, licence_of_sketchfab, spdx_of
from datagen.objects.errors import ObjectError


@pytest.mark.parametrize(
    ("written", "spdx"),
    [
        ("cc0", "CC0-1.0"),
        ("by", "CC-BY-4.0"),
        (" BY-NC-SA ", "CC-BY-NC-SA-4.0"),
        ("cc-by-nd", "CC-BY-ND-4.0"),
        ("CC-BY-3.0", "CC-BY-3.0"),
        ("cc-by-nc-4.0", "CC-BY-NC-4.0"),
        ("mit", "MIT"),
        ("editorial", "LicenseRef-Sketchfab-Editorial"),
        ("licenseref-sketchfab-standard", "LicenseRef-Sketchfab-Standard"),
        ("LicenseRef-Ours", "LicenseRef-Ours"),
        ("NOASSERTION", "NOASSERTION"),
    ],
)
def test_what_users_write(written, spdx):
    assert spdx_of(written) == spdx


@pytest.mark.parametrize(
    ("typo", "meant"), [("cc00", "cc0"), ("editoral", "editorial"), ("CC-BY-4", "CC-BY-4.0")]
)
def test_typos_get_a_suggestion(typo, meant):
    with pytest.raises(ObjectError, match=f"'{typo}'.*is not known.*Did you mean '{meant}'"):
        spdx_of(typo)


def test_nonsense_gets_none():
    with pytest.raises(ObjectError, match=r"spdx\.org"):
        spdx_of("qqqqq")


@pytest.mark.parametrize(
    ("slug", "spdx"),
    [
        ("by-nc-nd", "CC-BY-NC-ND-4.0"),
        ("standard", "LicenseRef-Sketchfab-Standard"),
        ("new", "NOASSERTION"),
        (None, "NOASSERTION"),
    ],
)
def test_slugs_in_metadata(slug, spdx):
    assert licence_of_sketchfab(slug) == spdx


def test_description_splits_what_was_joined():
    joined = joined_licences("CC-BY-NC-4.0", "MIT", "CC-BY-NC-4.0")
    assert joined == "CC-BY-NC-4.0 AND MIT"
    assert ObjectDescription(licence=joined).licences == ("CC-BY-NC-4.0", "MIT")
    assert ObjectDescription(licence="MIT").licences == ("MIT",)
