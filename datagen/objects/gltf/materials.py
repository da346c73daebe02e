"""Materials of glTF 2.0 as metallic-roughness, and the coordinates by which their images lie on the surface."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from datagen.objects.errors import ObjectError
from datagen.objects.files.texture_images import has_alpha, permitted_image
from datagen.objects.gltf.container import GltfFile
from datagen.objects.gltf.specular_gloss import SpecularGloss, metallic_roughness
from datagen.objects.mesh.object_mesh import ImageLayout, Material
from shards.texture_wrap import WRAPS, Wrap

__all__ = ["SPECULAR_GLOSS", "UNLIT", "WEBP", "GltfMaterial", "UvSource", "read_material"]

SPECULAR_GLOSS = "KHR_materials_pbrSpecularGlossiness"
UNLIT = "KHR_materials_unlit"
EMISSIVE_STRENGTH = "KHR_materials_emissive_strength"
TRANSMISSION = "KHR_materials_transmission"
IOR = "KHR_materials_ior"
DRAWN = (SPECULAR_GLOSS, UNLIT, EMISSIVE_STRENGTH, TRANSMISSION, IOR)
WEBP = "EXT_texture_webp"
UNLIT_ROUGHNESS = 0.9  # of the fallback in the extension's own example
# How to get images of which a file has none that is read here.
CONVERSIONS = {
    "KHR_texture_basisu": "Convert the textures: `npx @gltf-transform/cli ktxdecompress in.glb out.glb`."
}

Numbers = tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class UvSource:
    """Coordinates of an image: a set of the file, moved by KHR_texture_transform."""

    tex_coord: int = 0
    offset: Numbers = (0.0, 0.0)
    rotation: float = 0.0
    scale: Numbers = (1.0, 1.0)

    def moved(self, uv: Float[np.ndarray, "vert 2"]) -> Float[np.ndarray, "vert 2"]:
        """UVs of the file as the image wants them; v grows downward in both (FORMATS 10.2)."""
        if self == UvSource(tex_coord=self.tex_coord):
            return uv
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        return (uv * self.scale) @ np.array([[c, s], [-s, c]]).T + self.offset


@dataclass(frozen=True, kw_only=True)
class GltfMaterial:
    """A material, what its `ImageLayout.uv_layer`s are made of, and what is not drawn of it."""

    material: Material
    uv_sources: tuple[UvSource, ...]  # at least one
    notes: tuple[str, ...] = ()

    @property
    def has_images(self) -> bool:
        look = self.material
        images = (
            look.base_color_image,
            look.metallic_roughness_image,
            look.normal_image,
            look.emissive_image,
        )
        return any(image is not None for image in images)


@dataclass(frozen=True, kw_only=True)
class _Texture:
    """One textureInfo; without an image where the material has none."""

    image: bytes | None = None
    uv: UvSource = UvSource()
    wrap_u: Wrap = "repeat"
    wrap_v: Wrap = "repeat"


def read_material(file: GltfFile, entry: dict[str, Any], max_image_px: int) -> GltfMaterial:
    """One entry of `materials`. ObjectError names textures that cannot be decoded here.

    Specular-gloss goes before metallic-roughness, as its specification wants. Unlit surfaces are
    drawn matt: our scenes have light.
    """
    extensions, name = entry.get("extensions", {}), str(entry.get("name", "unnamed"))
    look = extensions.get(SPECULAR_GLOSS)
    strength = _number(extensions.get(EMISSIVE_STRENGTH, {}).get("emissiveStrength", 1.0))
    glow = [max(strength * value, 0.0) for value in _numbers(entry.get("emissiveFactor", (0, 0, 0)), 3)]
    values, textures = (
        _metallic_roughness(file, entry) if look is None else _specular_gloss(file, look, name, max_image_px)
    )
    if UNLIT in extensions:
        values |= {"metallic": 0.0, "roughness": UNLIT_ROUGHNESS}
        textures["metallic_roughness"] = _Texture()
    textures["emissive"] = _texture(file, entry.get("emissiveTexture"))
    textures["normal"] = _texture(file, entry.get("normalTexture"))
    uv_sources: list[UvSource] = []
    for slot in ("base_color", "emissive", "metallic_roughness", "normal"):  # colours have the first layers
        texture = textures[slot]
        if texture.image is None:
            continue
        if texture.uv not in uv_sources:
            uv_sources.append(texture.uv)
        layer = uv_sources.index(texture.uv)
        values |= {
            f"{slot}_image": texture.image,
            f"{slot}_layout": ImageLayout(uv_layer=layer, wrap_u=texture.wrap_u, wrap_v=texture.wrap_v),
        }
    material = Material(
        name=name,
        **values,
        emissive_rgb=(glow[0], glow[1], glow[2]),
        transmission=_share(extensions.get(TRANSMISSION, {}).get("transmissionFactor", 0)),
        ior=max(_number(extensions.get(IOR, {}).get("ior", 1.45)), 1.0),
    )
    return GltfMaterial(
        material=material, uv_sources=tuple(uv_sources) or (UvSource(),), notes=_notes(entry, material)
    )


def _notes(entry: dict[str, Any], material: Material) -> tuple[str, ...]:
    """What this material has and our images do not."""
    unseen = sorted(
        name
        for name in entry.get("extensions", {})
        if name.startswith("KHR_materials_") and name not in DRAWN
    )
    notes = [f"material {material.name!r} is drawn without {', '.join(unseen)}"] if unseen else []
    mode, image = entry.get("alphaMode", "OPAQUE"), material.base_color_image
    if mode != "OPAQUE" and (material.base_color_rgba[3] < 1.0 or (image is not None and has_alpha(image))):
        notes.append(
            f"material {material.name!r} ({mode}) is drawn opaque: masks and images show one outline"
        )
    return tuple(notes)


def _metallic_roughness(file: GltfFile, entry: dict[str, Any]) -> tuple[dict[str, Any], dict[str, _Texture]]:
    pbr = entry.get("pbrMetallicRoughness", {})
    values = {
        "base_color_rgba": tuple(map(_share, _numbers(pbr.get("baseColorFactor", (1, 1, 1, 1)), 4))),
        "metallic": _share(pbr.get("metallicFactor", 1)),
        "roughness": _share(pbr.get("roughnessFactor", 1)),
    }
    return values, {
        "base_color": _texture(file, pbr.get("baseColorTexture")),
        "metallic_roughness": _texture(file, pbr.get("metallicRoughnessTexture")),
    }


def _specular_gloss(
    file: GltfFile, look: dict[str, Any], name: str, max_image_px: int
) -> tuple[dict[str, Any], dict[str, _Texture]]:
    diffuse, gloss = (
        _texture(file, look.get(key)) for key in ("diffuseTexture", "specularGlossinessTexture")
    )
    layouts = {(t.uv, t.wrap_u, t.wrap_v) for t in (diffuse, gloss) if t.image is not None}
    if len(layouts) > 1:
        raise ObjectError(
            file.path,
            f"the two images of the specular-gloss material {name!r} have other coordinates or wrapping",
            expected="both alike, as they are converted texel by texel",
            action="Convert it: `npx @gltf-transform/cli metalrough in.glb out.glb`.",
        )
    images = [
        None
        if texture.image is None
        else permitted_image(texture.image, file.path, f"an image of material {name!r}", max_image_px)
        for texture in (diffuse, gloss)
    ]
    converted = metallic_roughness(
        SpecularGloss(
            diffuse_rgba=tuple(map(_share, _numbers(look.get("diffuseFactor", (1, 1, 1, 1)), 4))),  # type: ignore[arg-type]
            diffuse_image=images[0],
            specular_rgb=tuple(map(_share, _numbers(look.get("specularFactor", (1, 1, 1)), 3))),  # type: ignore[arg-type]
            glossiness=_share(look.get("glossinessFactor", 1)),
            specular_gloss_image=images[1],
        )
    )
    uv, wrap_u, wrap_v = next(iter(layouts), (UvSource(), "repeat", "repeat"))
    values = {
        "base_color_rgba": converted.base_color_rgba,
        "metallic": converted.metallic,
        "roughness": converted.roughness,
    }
    return values, {
        slot: _Texture(image=image, uv=uv, wrap_u=wrap_u, wrap_v=wrap_v)
        for slot, image in (
            ("base_color", converted.base_color_image),
            ("metallic_roughness", converted.metallic_roughness_image),
        )
    }


def _number(value: object) -> float:
    """A finite number; ValueError for anything else (`read_gltf` names the file)."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"a material has {value!r} for a number")
    return float(value)


def _share(value: object) -> float:
    """A number in 0..1, clipped as viewers do."""
    return min(max(_number(value), 0.0), 1.0)


def _numbers(values: Sequence[object], count: int) -> Numbers:
    if len(values) != count:
        raise ValueError(f"a material has {len(values)} numbers in place of {count}")
    return tuple(_number(value) for value in values)


def _texture(file: GltfFile, info: dict[str, Any] | None) -> _Texture:
    if info is None:
        return _Texture()
    texture = file.entry("textures", info["index"])
    extensions = texture.get("extensions", {})
    source = extensions.get(WEBP, texture).get("source", texture.get("source"))
    if source is None:
        # KHR_texture_basisu, MSFT_texture_dds and the like: GPU formats without a fallback image.
        raise ObjectError(
            file.path,
            f"texture {info['index']} exists as {', '.join(sorted(extensions)) or 'no image at all'} only",
            expected="a PNG, JPEG or WebP image",
            action=next(
                (CONVERSIONS[name] for name in extensions if name in CONVERSIONS),
                "Export it again with PNG or JPEG textures.",
            ),
        )
    sampler = file.entry("samplers", texture["sampler"]) if "sampler" in texture else {}
    wraps = [sampler.get(key, 10497) for key in ("wrapS", "wrapT")]
    if any(wrap not in WRAPS for wrap in wraps):
        raise file.damaged(f"a sampler has the wrap modes {wraps}")
    return _Texture(
        image=file.image(source), uv=_uv_source(file, info), wrap_u=WRAPS[wraps[0]], wrap_v=WRAPS[wraps[1]]
    )


def _uv_source(file: GltfFile, info: dict[str, Any]) -> UvSource:
    moved = info.get("extensions", {}).get("KHR_texture_transform", {})
    tex_coord = moved.get("texCoord", info.get("texCoord", 0))
    if type(tex_coord) is not int or tex_coord < 0:
        raise file.damaged(f"a texture has the texCoord {tex_coord!r}")
    return UvSource(
        tex_coord=tex_coord,
        offset=_numbers(moved.get("offset", (0, 0)), 2),
        rotation=_number(moved.get("rotation", 0)),
        scale=_numbers(moved.get("scale", (1, 1)), 2),
    )
