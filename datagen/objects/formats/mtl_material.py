"""From an MTL entry (a model of the 1990s) to a metallic-roughness material."""

from dataclasses import dataclass, field

import numpy as np

from datagen.objects.mesh.object_mesh import Material
from shards.color import linear_from_srgb

__all__ = ["MtlEntry", "material_from_mtl"]

RGB = tuple[float, float, float]

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


@dataclass(frozen=True, kw_only=True)
class MtlEntry:
    """The keywords of one newmtl block that change how it looks."""

    name: str
    kd: RGB = (0.8, 0.8, 0.8)
    ks: RGB = (0.0, 0.0, 0.0)
    ke: RGB = (0.0, 0.0, 0.0)
    ns: float = 10.0  # Phong exponent
    opacity: float = 1.0
    ior: float = 1.0
    roughness: float | None = None  # Pr, Pm: the PBR extension
    metallic: float | None = None
    maps: dict[str, str] = field(default_factory=dict)  # map_kd, map_bump ... -> file name

    @classmethod
    def from_words(cls, name: str, words: dict[str, list[str]]) -> "MtlEntry":
        """Parse the words after each keyword; ValueError where a number is not one."""

        def rgb(key: str, default: RGB) -> RGB:
            values = [float(word) for word in words.get(key, [])]
            return (values * 3)[:3] if len(values) == 1 else tuple(values[:3]) or default  # type: ignore[return-value]

        def number(key: str, default: float) -> float:
            return float(words[key][-1]) if words.get(key) else default

        opacity = number("d", 1.0 - number("tr", 0.0))
        return cls(
            name=name,
            kd=rgb("kd", (0.8, 0.8, 0.8)),
            ks=rgb("ks", (0.0, 0.0, 0.0)),
            ke=rgb("ke", (0.0, 0.0, 0.0)),
            ns=number("ns", 10.0),
            opacity=min(max(opacity, 0.0), 1.0),
            ior=number("ni", 1.0),
            roughness=number("pr", 0.5) if "pr" in words else None,
            metallic=number("pm", 0.0) if "pm" in words else None,
            maps={
                key: _file_name(value) for key, value in words.items() if key in ("map_kd", "map_ke", "norm")
            },
        )


def _file_name(words: list[str]) -> str:
    """The name after options such as `-s 1 1 1`; names may contain spaces."""
    last_option = max(
        (k for k, word in enumerate(words) if word.startswith("-") and len(word) > 1), default=None
    )
    if last_option is None:
        return " ".join(words)
    return " ".join(words[last_option + 1 :][-1:])


def _roughness(entry: MtlEntry, specular: float) -> float:
    """Beckmann match of a Phong exponent: alpha = sqrt(2 / (Ns + 2)), roughness = sqrt(alpha).

    A weak highlight (Ks) also means a rough surface: exporters write Ns 96 with Ks 0 for cloth.
    """
    from_exponent = (2.0 / (max(entry.ns, 0.0) + 2.0)) ** 0.25
    from_strength = 0.85 - 1.3 * min(specular, 0.55)
    return float(np.clip(max(from_exponent, from_strength), 0.08, 0.95))


def material_from_mtl(entry: MtlEntry, images: dict[str, bytes]) -> Material:
    """Plausible physically based values; `images` holds the bytes of `entry.maps`.

    Kd is read as a display (sRGB) colour, as viewers of its time drew it, and is ignored where
    map_Kd exists, as common importers do. Opacity below 0.95 becomes transmission: in household
    models it means glass or clear plastic.
    """
    name = entry.name.lower()
    specular = float(np.mean(entry.ks))
    is_metal = any(word in name for word in METAL_WORDS) or (specular >= 0.65 and max(entry.kd) < 0.85)
    metallic = entry.metallic if entry.metallic is not None else float(is_metal)
    transmission = 1.0 if entry.opacity < 0.95 else 0.0
    is_glass = transmission > 0 and any(word in name for word in GLASS_WORDS)
    roughness = entry.roughness if entry.roughness is not None else _roughness(entry, specular)
    if transmission:
        metallic = 0.0
        roughness = 0.02 if is_glass else min(roughness, 0.15)
    elif metallic > 0.5 and entry.roughness is None:
        roughness = min(roughness, 0.35)
    color = np.array(entry.kd) if "map_kd" not in images else np.ones(3)
    linear = linear_from_srgb(np.clip(color, 0.0, 1.0))
    if transmission:  # a tint, not a diffuse colour: grey glass is clear glass
        linear = linear / max(float(linear.max()), 1e-3) * (0.97 if is_glass else 0.9)
    return Material(
        name=entry.name,
        base_color_rgba=(*(float(value) for value in linear), 1.0),  # type: ignore[arg-type]
        base_color_image=images.get("map_kd"),
        metallic=metallic,
        roughness=roughness,
        normal_image=images.get("norm"),
        emissive_rgb=tuple(float(v) for v in linear_from_srgb(np.array(entry.ke))),  # type: ignore[arg-type]
        emissive_image=images.get("map_ke"),
        transmission=transmission,
        ior=entry.ior if entry.ior >= 1.2 else (1.5 if is_glass else 1.45),
    )
