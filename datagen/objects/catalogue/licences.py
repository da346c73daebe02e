"""Licences by their SPDX ids, and the short names that Sketchfab and Objaverse use."""

import difflib

from datagen.objects.errors import ObjectError

__all__ = ["UNKNOWN_LICENCE", "joined_licences", "licence_of_sketchfab", "licence_parts", "spdx_of"]

UNKNOWN_LICENCE = "NOASSERTION"
AND = " AND "  # of SPDX expressions: all of them apply

# Sketchfab's slugs, as in the "license" of Objaverse's metadata. Its CC licences are version 4.0.
SKETCHFAB_LICENCES = {
    "cc0": "CC0-1.0",
    "by": "CC-BY-4.0",
    "by-sa": "CC-BY-SA-4.0",
    "by-nd": "CC-BY-ND-4.0",
    "by-nc": "CC-BY-NC-4.0",
    "by-nc-sa": "CC-BY-NC-SA-4.0",
    "by-nc-nd": "CC-BY-NC-ND-4.0",
    "standard": "LicenseRef-Sketchfab-Standard",
    "st": "LicenseRef-Sketchfab-Standard",
    "free-st": "LicenseRef-Sketchfab-Standard",
    "editorial": "LicenseRef-Sketchfab-Editorial",
    "ed": "LicenseRef-Sketchfab-Editorial",
}
CREATIVE_COMMONS = ("BY", "BY-SA", "BY-ND", "BY-NC", "BY-NC-SA", "BY-NC-ND")
# SPDX ids that meshes are found under; the CC family in every version with an SPDX id.
KNOWN_SPDX = (
    *(f"CC-{kind}-{version}" for kind in CREATIVE_COMMONS for version in ("1.0", "2.0", "2.5", "3.0", "4.0")),
    *sorted({value for value in SKETCHFAB_LICENCES.values() if not value.startswith("CC-")}),
    "Apache-2.0",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "CC-PDDC",
    "GPL-2.0-only",
    "GPL-2.0-or-later",
    "GPL-3.0-only",
    "GPL-3.0-or-later",
    "LAL-1.3",
    "MIT",
    "ODC-By-1.0",
    "PDDL-1.0",
    UNKNOWN_LICENCE,
)


def joined_licences(*licences: str) -> str:
    """The SPDX expression for work under all of them, each once: "CC-BY-NC-4.0 AND CC-BY-4.0"."""
    return AND.join(dict.fromkeys(licences))


def licence_parts(expression: str) -> tuple[str, ...]:
    """The licences of an expression that `joined_licences` gave; all must be allowed."""
    return tuple(expression.split(AND))


def licence_of_sketchfab(slug: str | None) -> str:
    """SPDX id of the "license" in Objaverse's metadata; NOASSERTION where it is absent or new."""
    return SKETCHFAB_LICENCES.get((slug or "").strip().lower(), UNKNOWN_LICENCE)


def spdx_of(short: str) -> str:
    """SPDX id of what a user writes: a short name ("cc0", "by-nc", "cc-by") or an SPDX id, in any case and also
    with blanks ("CC BY 4.0").

    Own licences ("LicenseRef-...") pass as they are. ObjectError with a suggestion for typos.
    """
    word = short.strip()
    spdx_by_word = _spdx_by_word()
    known = spdx_by_word.get("-".join(word.lower().replace("_", " ").split()))
    if known is not None:
        return known
    if word.startswith("LicenseRef-"):
        return word
    close = difflib.get_close_matches(word.lower(), spdx_by_word, n=1, cutoff=0.5)
    raise ObjectError(
        f"licence {short!r}",
        "is not known",
        expected=f"one of {', '.join(SKETCHFAB_LICENCES)}, or an SPDX id such as CC-BY-4.0",
        action=f"Did you mean {_as_written(close[0])!r}?"
        if close
        else "See https://spdx.org/licenses for the ids.",
    )


def _as_written(word: str) -> str:
    return word if word in SKETCHFAB_LICENCES else _spdx_by_word()[word]


def _spdx_by_word() -> dict[str, str]:
    with_prefix = {f"cc-{slug}": spdx for slug, spdx in SKETCHFAB_LICENCES.items() if slug.startswith("by")}
    return {**{spdx.lower(): spdx for spdx in KNOWN_SPDX}, **with_prefix, **SKETCHFAB_LICENCES}
