"""Cycles settings: those the Scene decides, and those chosen once by measurement (DECISIONS D82, D83)."""

import hashlib

import bpy

from datagen.blender.devices import Device
from datagen.scene.scene import Scene

__all__ = ["apply_settings", "sampling_seed"]

_GLASS_BOUNCES = 10  # into and out of four walls, and on to what is behind


def apply_settings(scene: Scene, device: Device, threads: int) -> None:
    """Set up Cycles and the film for 8-bit sRGB PNG files; `threads` 0 takes every core.

    Paths through a transmissive object may be longer than `max_bounces`.
    """
    settings, has_glass = scene.render, any(m.transmission > 0.0 for m in scene.object_mesh.materials)
    blender = bpy.context.scene
    render, cycles, view = blender.render, blender.cycles, blender.view_settings
    render.engine = "CYCLES"
    render.threads_mode, render.threads = ("FIXED", threads) if threads else ("AUTO", 1)
    render.use_persistent_data = True  # keep textures and the BVH of whatever did not change

    cycles.samples = settings.samples
    cycles.use_adaptive_sampling = False
    cycles.diffuse_bounces = cycles.glossy_bounces = settings.max_bounces
    cycles.transmission_bounces = _GLASS_BOUNCES if has_glass else settings.max_bounces
    cycles.max_bounces = max(settings.max_bounces, cycles.transmission_bounces)
    cycles.transparent_max_bounces = _GLASS_BOUNCES
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.blur_glossy = 0.5
    cycles.sample_clamp_direct, cycles.sample_clamp_indirect = 0.0, 4.0
    cycles.use_light_tree = False  # a few lamps and one world: sampling them in turn is as good
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 1.5

    cycles.use_denoising = settings.denoise
    cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
    cycles.denoising_prefilter = "FAST"
    cycles.denoising_quality = "HIGH"
    cycles.denoising_use_gpu = device.backend != "CPU"

    view.view_transform = settings.view_transform
    view.look = "AgX - Medium High Contrast" if settings.view_transform == "AgX" else "None"
    view.exposure = settings.exposure_ev
    for stamp in [name for name in dir(render) if name.startswith("use_stamp")]:
        setattr(render, stamp, False)  # dates and durations in the files would make equal images differ
    render.dither_intensity = 0.0
    render.film_transparent = False
    image = render.image_settings
    image.file_format, image.color_mode, image.color_depth, image.compression = "PNG", "RGB", "8", 15


def sampling_seed(seed: int, camera: int, frame: int) -> int:
    """Cycles' seed of one image, the same in whatever order images are rendered."""
    digest = hashlib.sha256(f"{seed} {camera} {frame}".encode()).digest()
    return int.from_bytes(digest[:4], "little") & 0x7FFFFFFF
