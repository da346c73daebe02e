"""What is known of an object before its mesh is read."""

from dataclasses import dataclass

from datagen.objects.objaverse_annotation import ObjaverseAnnotation

__all__ = ["ObjectDescription"]


@dataclass(frozen=True, kw_only=True)
class ObjectDescription:
    """Enough to decide on an object by licence and annotation."""

    licence: str  # SPDX id
    annotation: ObjaverseAnnotation | None = None  # None: the library has none
