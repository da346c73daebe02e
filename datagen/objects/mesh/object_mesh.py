"""What is drawn of an object: triangles, corner UVs and colours, physically based materials."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from shards.texture_wrap import Wrap

__all__ = ["ImageLayout", "Material", "ObjectMesh"]


@dataclass(frozen=True, kw_only=True)
class ImageLayout:
    """How an image lies on the surface: by which UVs, and what is seen beyond its borders."""

    uv_layer: int = 0  # 0: `corner_uv`, k: the k-th of `more_corner_uv`, counted from 1
    wrap_u: Wrap = "repeat"
    wrap_v: Wrap = "repeat"


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
    base_color_layout: ImageLayout = ImageLayout()
    metallic_roughness_layout: ImageLayout = ImageLayout()
    normal_layout: ImageLayout = ImageLayout()
    emissive_layout: ImageLayout = ImageLayout()


@dataclass(frozen=True, kw_only=True)
class ObjectMesh:
    """Triangles in the object frame. Vertices may be shared across UV seams (UVs sit on corners)."""

    verts_obj: Float[np.ndarray, "vert 3"]  # metres
    faces: Int[np.ndarray, "face 3"]
    corner_uv: Float[np.ndarray, "face 3 2"]  # (0, 0) is the lower left of the image
    face_material: Int[np.ndarray, " face"]  # index into `materials`
    materials: tuple[Material, ...]
    smooth: bool = True  # smooth shading with 40 degree auto-smooth; False: flat
    corner_colors: Float[np.ndarray, "face 3 rgb"] | None = None  # linear 0..1; times the base colour
    more_corner_uv: tuple[
        Float[np.ndarray, "face 3 2"], ...
    ] = ()  # of images that lie otherwise (ImageLayout)

    def uv_of(self, layout: ImageLayout) -> Float[np.ndarray, "face 3 2"]:
        """The coordinates by which an image lies on the surface."""
        return (self.corner_uv, *self.more_corner_uv)[layout.uv_layer]

    def with_corners(self, change: Callable[[np.ndarray], np.ndarray], **fields: Any) -> "ObjectMesh":
        """All that sits on corners (rows of shape "face 3 column") changed alike, beside other `fields`."""
        return replace(
            self,
            corner_uv=change(self.corner_uv),
            more_corner_uv=tuple(change(uv) for uv in self.more_corner_uv),
            corner_colors=None if self.corner_colors is None else change(self.corner_colors),
            **fields,
        )
