"""Decoded voxels to one checked watertight mesh: extraction, crumbs, simplification, proof."""

from dataclasses import dataclass

from model.surface.extraction import ExtractionConfig, extract_surface
from model.surface.fields import SurfaceFields
from model.surface.mesh import MeshReport, SurfaceMesh, check_manifold
from model.surface.simplification import simplify, without_small_components

__all__ = ["ExtractedSurface", "SurfaceExtractionConfig", "extracted_surface"]


@dataclass(frozen=True, kw_only=True)
class SurfaceExtractionConfig:
    """From decoded voxels to the mesh that is handed out."""

    extraction: ExtractionConfig
    min_component_share: float  # of the largest component's volume; smaller ones are dropped
    max_faces: int  # colours sit on vertices: fewer faces blur them
    max_simplification_move: float  # canonical units; the surface moves no further for max_faces


@dataclass(frozen=True, kw_only=True)
class ExtractedSurface:
    """A mesh that passed `check_manifold`, and what was assumed and dropped for it."""

    mesh: SurfaceMesh
    report: MeshReport
    exposed_corners: int
    uncolored_vertices: int
    dropped_components: int


def extracted_surface(fields: SurfaceFields, config: SurfaceExtractionConfig) -> ExtractedSurface:
    """Manifold, watertight, outward, in the canonical frame. ModelError: no voxel, nothing inside, not watertight."""
    extracted = extract_surface(fields, config.extraction)
    whole, dropped = without_small_components(extracted.mesh, config.min_component_share)
    mesh = simplify(whole, config.max_faces, config.max_simplification_move)
    return ExtractedSurface(
        mesh=mesh,
        report=check_manifold(mesh),
        exposed_corners=extracted.exposed_corners,
        uncolored_vertices=extracted.uncolored_vertices,
        dropped_components=dropped,
    )
