"""What is drawn of an object: triangles, corner UVs and physically based materials."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

__all__ = ["Material", "ObjectMesh"]


@dataclass(frozen=True, kw_only=True)
class Material:
    """One glTF-style metallic-roughness material. Factors multiply their images.

    Images are encoded files (PNG or JPEG bytes); colour images are sRGB, the others linear.
    """

    name: str
    base_color_rgba: tuple[float, float, float, float]  # linear, 0..1
    base_color_image: bytes | None = None
    metallic: float = 0.0
    roughness: float = 0.5
    metallic_roughness_image: bytes | None = None  # glTF: G roughness, B metallic
    normal_image: bytes | None = None  # tangent space, +Y up
    emissive_rgb: tuple[float, float, float] = (0.0, 0.0, 0.0)  # linear
    emissive_image: bytes | None = None
    transmission: float = 0.0  # 1: clear glass
    ior: float = 1.45


@dataclass(frozen=True, kw_only=True)
class ObjectMesh:
    """Triangles in the object frame. Vertices may be shared across UV seams (UVs sit on corners)."""

    verts_obj: Float[np.ndarray, "vert 3"]  # metres
    faces: Int[np.ndarray, "face 3"]
    corner_uv: Float[np.ndarray, "face 3 2"]  # (0, 0) is the lower left of the image
    face_material: Int[np.ndarray, " face"]  # index into `materials`
    materials: tuple[Material, ...]
    smooth: bool = True  # smooth shading with 40 degree auto-smooth; False: flat
