"""From an MTL entry (a model of the 1990s) to a metallic-roughness material."""

import numpy as np

from datagen.objects.mesh.object_mesh import Material
from datagen.objects.wavefront.mtl_file import MtlEntry
from shards.color import linear_from_srgb

__all__ = ["PLAIN_KD", "material_from_mtl"]

METAL_WORDS = (
    "chrome",
    "krome",
    "metal",
    "steel",
    "silver",
    "gold",
    "brass",
    "copper",
    "iron",
    "alumin",
    "inox",
)
GLASS_WORDS = ("glass", "verre", "cristal", "crystal", "pane")
PLAIN_KD = (0.8, 0.8, 0.8)  # of a material without Kd


def _roughness(entry: MtlEntry, specular: float) -> float:
    """Beckmann match of a Phong exponent: alpha = sqrt(2 / (Ns + 2)), roughness = sqrt(alpha).

    A weak highlight (Ks) also means a rough surface: exporters write Ns 96 with Ks 0 for cloth.
    """
    from_exponent = (2.0 / (max(entry.ns, 0.0) + 2.0)) ** 0.25
    from_strength = 0.85 - 1.3 * min(specular, 0.55)
    return float(np.clip(max(from_exponent, from_strength), 0.08, 0.95))


def material_from_mtl(entry: MtlEntry, images: dict[str, bytes]) -> Material:
    """Plausible physically based values; `images` may hold "map_kd", "map_ke" and "norm".

    Kd is read as a display (sRGB) colour, as viewers of its time drew it, and is ignored where
    map_Kd exists, as common importers do; a Ke of 0 does not hide map_Ke. Opacity below 0.95
    becomes transmission: in household models it means glass or clear plastic.
    """
    name = entry.name.lower()
    kd = entry.kd or PLAIN_KD
    specular = float(np.mean(entry.ks))
    is_metal = any(word in name for word in METAL_WORDS) or (specular >= 0.65 and max(kd) < 0.85)
    metallic = entry.metallic if entry.metallic is not None else float(is_metal)
    transmission = 1.0 if entry.opacity < 0.95 else 0.0
    is_glass = transmission > 0 and any(word in name for word in GLASS_WORDS)
    roughness = entry.roughness if entry.roughness is not None else _roughness(entry, specular)
    if transmission:
        metallic = 0.0
        roughness = 0.02 if is_glass else min(roughness, 0.15)
    elif metallic > 0.5 and entry.roughness is None:
        roughness = min(roughness, 0.35)
    color = np.array(kd) if "map_kd" not in images else np.ones(3)
    linear = linear_from_srgb(np.clip(color, 0.0, 1.0))
    if transmission:  # a tint, not a diffuse colour: grey glass is clear glass
        linear = linear / max(float(linear.max()), 1e-3) * (0.97 if is_glass else 0.9)
    glow = entry.ke if any(entry.ke) or "map_ke" not in images else (1.0, 1.0, 1.0)
    return Material(
        name=entry.name,
        base_color_rgba=(*(float(value) for value in linear), 1.0),  # type: ignore[arg-type]
        base_color_image=images.get("map_kd"),
        metallic=min(max(metallic, 0.0), 1.0),
        roughness=min(max(roughness, 0.0), 1.0),
        normal_image=images.get("norm"),
        emissive_rgb=tuple(float(v) for v in linear_from_srgb(np.array(glow))),  # type: ignore[arg-type]
        emissive_image=images.get("map_ke"),
        transmission=transmission,
        ior=entry.ior if entry.ior >= 1.2 else (1.5 if is_glass else 1.45),
    )
