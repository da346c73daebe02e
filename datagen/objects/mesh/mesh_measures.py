"""What a selection measures of a drawn mesh."""

from dataclasses import dataclass

from datagen.objects.mesh.fingerprint import Fingerprint, fingerprint_of
from datagen.objects.mesh.object_mesh import ObjectMesh
from datagen.objects.mesh.texture_quality import TextureQuality, measure_texture_quality, texture_samples

__all__ = ["MeshMeasures", "measure_mesh"]


@dataclass(frozen=True, kw_only=True)
class MeshMeasures:
    """Texture quality and fingerprint, and what the reader of the file had to guess or leave out."""

    texture: TextureQuality
    fingerprint: Fingerprint
    notes: tuple[str, ...]


def measure_mesh(mesh: ObjectMesh, *, notes: tuple[str, ...] = ()) -> MeshMeasures:
    """Deterministic; texture images are unpacked once."""
    samples = texture_samples(mesh)
    return MeshMeasures(
        texture=measure_texture_quality(mesh, samples),
        fingerprint=fingerprint_of(mesh, samples),
        notes=notes,
    )
