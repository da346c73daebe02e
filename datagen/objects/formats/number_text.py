"""Many numbers of a text at once."""

import re
import warnings
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datagen.objects.errors import ObjectError

__all__ = ["numbers_of"]

SHOWN_CHARS = 40


def numbers_of(text: bytes, source: Path, what: str) -> Float[np.ndarray, " number"]:
    """Numbers separated by white space, in C notation. ObjectError quotes the first that is none.

    `what` says in the error where the text stands in the file.
    """
    if not text.strip():
        return np.zeros(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # NumPy's word for a text that is no number
        try:
            return np.fromstring(text, dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError) as error:
            raise _not_a_number(text, source, what) from error


def _not_a_number(text: bytes, source: Path, what: str) -> ObjectError:
    word = next((word for word in map(bytes.strip, text.split()) if not _is_number(word)), b"")
    shown = word.decode("latin-1")[:SHOWN_CHARS]
    if re.fullmatch(rb"[+-]?\d+,\d+([eE][+-]?\d+)?", word):
        return ObjectError(
            source,
            f"writes {what} with a decimal comma ({shown!r})",
            expected="decimal points",
            action="Export the mesh again with a locale such as English or C.",
        )
    return ObjectError(
        source,
        f"has {shown!r} among {what}",
        expected="numbers",
        action="Export the mesh again, for instance with Blender.",
    )


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return b"_" not in word
