"""What is known of an object before its mesh is read."""

from dataclasses import dataclass
from typing import Literal

from datagen.objects.catalogue.licences import licence_parts
from datagen.objects.catalogue.objaverse_annotation import ObjaverseAnnotation

__all__ = ["Appearance", "ObjectDescription"]

# Of the file itself, or made up for a shape that came without one (`plain_look`).
Appearance = Literal["original", "generated"]


@dataclass(frozen=True, kw_only=True)
class ObjectDescription:
    """Enough to decide on an object by licence and annotation."""

    licence: str  # SPDX id, or several that all apply: "CC-BY-NC-4.0 AND CC-BY-4.0"
    annotation: ObjaverseAnnotation | None = None  # None: the library has none
    appearance: Appearance = "original"  # what `load` would draw

    @property
    def licences(self) -> tuple[str, ...]:
        """The SPDX ids of `licence`; all of them apply."""
        return licence_parts(self.licence)
