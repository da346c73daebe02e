"""What Objaverse's metadata tell of one model."""

from dataclasses import dataclass
from typing import Any, TypeVar

from datagen.objects.catalogue.licences import licence_of_sketchfab
from datagen.objects.errors import ObjectError

__all__ = ["ObjaverseAnnotation", "annotation_of_record"]

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True, slots=True)
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


@dataclass(frozen=True, kw_only=True)
class _Record:
    """Part of a record; `where` leads to it, such as "archives.glb."."""

    entries: dict[str, Any]
    where: str
    source: object
    uid: str

    def get(self, key: str, kind: type[T]) -> T | None:
        """The value; None where it is absent or null, ObjectError where it is of another type."""
        value = self.entries.get(key)
        if value is None or type(value) is kind:  # exactly: True is no number
            return value
        raise _malformed(self.source, self.uid, f"has {self.where}{key} = {value!r:.60}", kind.__name__)

    def below(self, key: str) -> "_Record":
        """The mapping under `key`, empty where it is absent."""
        entries: dict[str, Any] = self.get(key, dict) or {}
        return _Record(entries=entries, where=f"{self.where}{key}.", source=self.source, uid=self.uid)


def annotation_of_record(
    record: object, category: str | None, *, source: object, uid: str
) -> ObjaverseAnnotation:
    """From one entry of metadata/000-xxx.json.gz and the LVIS category.

    ObjectError names `source`, `uid` and the key where a value has the wrong type.
    """
    if not isinstance(record, dict):
        raise _malformed(source, uid, f"is {record!r:.60}", "dict")
    told = _Record(entries=record, where="", source=source, uid=uid)
    user, glb = told.below("user"), told.below("archives").below("glb")
    face_count = told.get("faceCount", int)
    return ObjaverseAnnotation(
        name=told.get("name", str) or None,
        licence=licence_of_sketchfab(told.get("license", str)),
        author=user.get("displayName", str) or user.get("username", str) or None,
        url=told.get("viewerUrl", str) or told.get("uri", str) or None,
        animation_count=told.get("animationCount", int),
        face_count=glb.get("faceCount", int) if face_count is None else face_count,
        texture_count=glb.get("textureCount", int),
        texture_max_resolution_px=glb.get("textureMaxResolution", int),
        age_restricted=told.get("isAgeRestricted", bool),
        category=category,
    )


def _malformed(source: object, uid: str, problem: str, kind: str) -> ObjectError:
    return ObjectError(
        source,
        f"the record of {uid} {problem}",
        expected=f"a value of type {kind} there, as Sketchfab writes it",
        action="Delete the file and download it again with the Python package objaverse.",
    )
