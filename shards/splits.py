"""Train, validation and test: decided by the object, so no test object is ever seen in training."""

import hashlib
from dataclasses import dataclass
from typing import Literal

__all__ = ["Split", "SplitRule", "object_identity", "split_of_object"]

Split = Literal["train", "val", "test"]


@dataclass(frozen=True, kw_only=True)
class SplitRule:
    """Fractions of objects; what remains is for training."""

    val_fraction: float
    test_fraction: float

    def __post_init__(self) -> None:
        fractions = (self.val_fraction, self.test_fraction)
        if min(fractions) < 0.0 or sum(fractions) > 1.0:
            raise ValueError(
                f"split fractions must be >= 0 and sum to at most 1, found val {self.val_fraction} "
                f"and test {self.test_fraction}"
            )


def object_identity(object_uid: str) -> str:
    """The uid without its variant: what follows an "@" in the last part of the path."""
    folder, slash, name = object_uid.rpartition("/")
    return folder + slash + name.partition("@")[0]


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
