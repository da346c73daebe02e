"""Materials of glTF 2.0 as metallic-roughness, and which UV coordinates they use."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from datagen.objects.errors import ObjectError
from datagen.objects.gltf.container import GltfFile
from datagen.objects.gltf.specular_gloss import SpecularGloss, metallic_roughness
from datagen.objects.mesh.object_mesh import Material

__all__ = ["SPECULAR_GLOSS", "UNLIT", "WEBP", "read_material", "transformed_uv", "uv_set"]

SPECULAR_GLOSS = "KHR_materials_pbrSpecularGlossiness"
UNLIT = "KHR_materials_unlit"
WEBP = "EXT_texture_webp"
UNLIT_ROUGHNESS = 0.9  # of the fallback in the extension's own example


def read_material(file: GltfFile, entry: dict[str, Any]) -> Material:
    """One entry of `materials`. ObjectError names textures that cannot be decoded here.

    Specular-gloss goes before metallic-roughness, as its specification wants. Unlit surfaces are
    drawn matt: our scenes have light.
    """
    extensions = entry.get("extensions", {})
    look = extensions.get(SPECULAR_GLOSS)
    strength = _number(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
    shading = _metallic_roughness(file, entry) if look is None else _specular_gloss(file, look)
    if UNLIT in extensions:
        shading |= {"metallic": 0.0, "roughness": UNLIT_ROUGHNESS, "metallic_roughness_image": None}
    return Material(
        name=str(entry.get("name", "unnamed")),
        **shading,
        normal_image=_texture(file, entry.get("normalTexture")),
        emissive_rgb=tuple(strength * value for value in _numbers(entry.get("emissiveFactor", (0, 0, 0)), 3)),  # type: ignore[arg-type]
        emissive_image=_texture(file, entry.get("emissiveTexture")),
        transmission=_number(extensions.get("KHR_materials_transmission", {}).get("transmissionFactor", 0)),
        ior=_number(extensions.get("KHR_materials_ior", {}).get("ior", 1.45)),
    )


def _metallic_roughness(file: GltfFile, entry: dict[str, Any]) -> dict[str, Any]:
    pbr = entry.get("pbrMetallicRoughness", {})
    return {
        "base_color_rgba": _numbers(pbr.get("baseColorFactor", (1, 1, 1, 1)), 4),
        "base_color_image": _texture(file, pbr.get("baseColorTexture")),
        "metallic": _number(pbr.get("metallicFactor", 1)),
        "roughness": _number(pbr.get("roughnessFactor", 1)),
        "metallic_roughness_image": _texture(file, pbr.get("metallicRoughnessTexture")),
    }


def _specular_gloss(file: GltfFile, look: dict[str, Any]) -> dict[str, Any]:
    stated = SpecularGloss(
        diffuse_rgba=_numbers(look.get("diffuseFactor", (1, 1, 1, 1)), 4),  # type: ignore[arg-type]
        diffuse_image=_texture(file, look.get("diffuseTexture")),
        specular_rgb=_numbers(look.get("specularFactor", (1, 1, 1)), 3),  # type: ignore[arg-type]
        glossiness=_number(look.get("glossinessFactor", 1)),
        specular_gloss_image=_texture(file, look.get("specularGlossinessTexture")),
    )
    try:
        converted = metallic_roughness(stated)
    except Exception as error:  # Pillow raises whatever its decoders raise
        raise ObjectError(
            file.path,
            f"an image of a specular-gloss material cannot be decoded ({error})",
            expected="PNG, JPEG or WebP",
            action="Save the image again.",
        ) from error
    return dict(vars(converted))


def _number(value: object) -> float:
    """A finite number; ValueError for anything else (`read_gltf` names the file)."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"a material has {value!r} for a number")
    return float(value)


def _numbers(values: Sequence[object], count: int) -> tuple[float, ...]:
    if len(values) != count:
        raise ValueError(f"a material has {len(values)} numbers in place of {count}")
    return tuple(_number(value) for value in values)


def _texture(file: GltfFile, info: dict[str, Any] | None) -> bytes | None:
    if info is None:
        return None
    texture = file.entry("textures", info["index"])
    extensions = texture.get("extensions", {})
    source = extensions.get(WEBP, texture).get("source", texture.get("source"))
    if source is None:
        # KHR_texture_basisu, MSFT_texture_dds and the like: GPU formats without a fallback image.
        raise ObjectError(
            file.path,
            f"texture {info['index']} exists as {', '.join(sorted(extensions)) or 'no image at all'} only",
            expected="a PNG, JPEG or WebP image",
            action="Convert the textures: `npx @gltf-transform/cli ktxdecompress in.glb out.glb`.",
        )
    return file.image(source)


def _base_color_info(file: GltfFile, material: int) -> dict[str, Any]:
    materials = file.json.get("materials", [])
    if material >= len(materials):
        return {}
    entry = materials[material]
    look = entry.get("extensions", {}).get(SPECULAR_GLOSS)
    if look is not None:
        return look.get("diffuseTexture", look.get("specularGlossinessTexture", {}))
    return entry.get("pbrMetallicRoughness", {}).get("baseColorTexture", {})


def uv_set(file: GltfFile, material: int) -> str:
    """The attribute with the coordinates of the base colour, "TEXCOORD_<n>"."""
    info = _base_color_info(file, material)
    moved = info.get("extensions", {}).get("KHR_texture_transform", {})
    return f"TEXCOORD_{moved.get('texCoord', info.get('texCoord', 0))}"


def transformed_uv(
    file: GltfFile, material: int, uv: Float[np.ndarray, "vert 2"]
) -> Float[np.ndarray, "vert 2"]:
    """KHR_texture_transform of the base colour, applied to the coordinates themselves."""
    moved = _base_color_info(file, material).get("extensions", {}).get("KHR_texture_transform")
    if not moved:
        return uv
    angle = moved.get("rotation", 0.0)
    rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    return (uv * moved.get("scale", (1.0, 1.0))) @ rotation.T + moved.get("offset", (0.0, 0.0))
