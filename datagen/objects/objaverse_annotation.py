"""What Objaverse's metadata tell of one model."""

from dataclasses import dataclass
from typing import Any

from datagen.objects.licences import licence_of_sketchfab

__all__ = ["ObjaverseAnnotation", "annotation_of_record"]


@dataclass(frozen=True, kw_only=True)
class ObjaverseAnnotation:
    """What Objaverse's metadata tell of one model. None: the record does not say."""

    name: str | None
    licence: str  # SPDX id; NOASSERTION where the record does not say
    author: str | None  # the display name, else the user name
    url: str | None  # the model's page
    animation_count: int | None
    face_count: int | None
    texture_count: int | None  # of the GLB
    texture_max_resolution_px: int | None  # of the GLB
    age_restricted: bool | None
    category: str | None  # LVIS


def annotation_of_record(record: dict[str, Any], category: str | None) -> ObjaverseAnnotation:
    """From one entry of metadata/000-xxx.json.gz and the LVIS category."""
    user = record.get("user") or {}
    glb = (record.get("archives") or {}).get("glb") or {}
    return ObjaverseAnnotation(
        name=record.get("name") or None,
        licence=licence_of_sketchfab(record.get("license")),
        author=user.get("displayName") or user.get("username") or None,
        url=record.get("viewerUrl") or record.get("uri") or None,
        animation_count=record.get("animationCount"),
        face_count=record.get("faceCount", glb.get("faceCount")),
        texture_count=glb.get("textureCount"),
        texture_max_resolution_px=glb.get("textureMaxResolution"),
        age_restricted=record.get("isAgeRestricted"),
        category=category,
    )
