"""Train, validation and test: decided by the object, so no test object is ever seen in training."""

import hashlib
from dataclasses import dataclass
from typing import Annotated, Literal

from shards.errors import SplitError
from shards.settings import Range

__all__ = ["ObjectSplits", "Split", "SplitRule", "identity_and_variant", "object_identity", "split_of_object"]

Split = Literal["train", "val", "test"]


@dataclass(frozen=True, kw_only=True)
class SplitRule:
    """Fractions of objects; what remains is for training."""

    val_fraction: Annotated[float, Range(0, 1)]
    test_fraction: Annotated[float, Range(0, 1)]

    def __post_init__(self) -> None:
        fractions = (self.val_fraction, self.test_fraction)
        if min(fractions) < 0.0 or sum(fractions) > 1.0:
            raise ValueError(
                f"split fractions must be >= 0 and sum to at most 1, found val {self.val_fraction} "
                f"and test {self.test_fraction}"
            )


def identity_and_variant(object_uid: str) -> tuple[str, str]:
    """A uid in two: "store/cup@large" is ("store/cup", "@large"), "batch@1/cup" is ("batch@1/cup", "").

    A variant begins at the first "@" of the last part of the path; folders may have one in their name.
    """
    folder, slash, name = object_uid.rpartition("/")
    plain, at, variant = name.partition("@")
    return folder + slash + plain, at + variant


def object_identity(object_uid: str) -> str:
    """The uid without its variant (another size, the mirror image)."""
    return identity_and_variant(object_uid)[0]


def split_of_object(object_uid: str, rule: SplitRule) -> Split:
    """The split of an object. Depends on nothing but the uid and the rule.

    Variants (another size, the mirror image) do not count (`object_identity`), so they never
    straddle splits. The first 8 bytes of SHA-256 of the rest, as a fraction u of
    2^64: test if u < test, val if u < test + val, else train. Raising val_fraction moves objects
    from train only.
    """
    identity = object_identity(object_uid)
    word = int.from_bytes(hashlib.sha256(identity.encode("utf-8")).digest()[:8], "big")
    u = word / 2**64
    if u < rule.test_fraction:
        return "test"
    if u < rule.test_fraction + rule.val_fraction:
        return "val"
    return "train"


class ObjectSplits:
    """The split of every object met so far, over any number of shards and datasets."""

    def __init__(self) -> None:
        self._met: dict[str, tuple[str, str]] = {}  # identity -> split, and where it says so

    def add(self, object_uid: str, split: str, *, where: str) -> None:
        """SplitError if a variant of the object was met in another split."""
        identity = object_identity(object_uid)
        known, known_where = self._met.setdefault(identity, (split, where))
        if known != split:
            raise SplitError(
                f"object '{identity}' is in split {split} here and in {known} in {known_where}",
                where=where,
                expected="each object in one split",
                fix="leave one of the datasets out, or render them with the same split fractions",
            )
