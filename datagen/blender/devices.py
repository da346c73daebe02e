"""Choose the device Cycles renders on, and say which one it really is."""

from dataclasses import dataclass
from typing import Any, Literal

import bpy

__all__ = ["Device", "DeviceError", "DeviceRequest", "found_devices", "select_device"]

DeviceRequest = Literal["auto", "cpu", "cuda", "optix", "hip", "metal"]

# Fastest first; OptiX drives the same cards as CUDA with hardware ray tracing.
_GPU_BACKENDS = ("OPTIX", "CUDA", "HIP", "METAL")


class DeviceError(ValueError):
    """The device that was demanded is not in this machine."""


@dataclass(frozen=True, kw_only=True)
class Device:
    """What Cycles renders on: `backend` is CPU, OPTIX, CUDA, HIP or METAL."""

    backend: str
    names: tuple[str, ...]


def found_devices() -> dict[str, tuple[str, ...]]:
    """Names of the devices of every backend that works here, GPUs first, the CPU always last."""
    preferences = _cycles_preferences()
    compiled = {item[0] for item in preferences.get_device_types(bpy.context)}
    found = {}
    for backend in _GPU_BACKENDS:
        devices = preferences.get_devices_for_type(backend) if backend in compiled else []
        names = tuple(device.name for device in devices if device.type == backend)
        if names:
            found[backend] = names
    found["CPU"] = tuple(device.name for device in preferences.devices if device.type == "CPU")
    return found


def select_device(request: DeviceRequest) -> Device:
    """Turn on the requested device for the current Blender scene and return what is in use.

    `auto` takes the first of OptiX, CUDA, HIP, Metal, CPU that is present. Raises DeviceError
    when a named device is missing: there is no silent fall-back to the CPU.
    """
    found = found_devices()
    backend = next(iter(found)) if request == "auto" else request.upper()
    if backend not in found:
        have = "; ".join(f"{kind.lower()}: {', '.join(names)}" for kind, names in found.items())
        raise DeviceError(
            f"--device {request}: no such device in this machine (found {have}); "
            "install its driver, or use --device auto or --device cpu"
        )
    cycles = bpy.context.scene.cycles
    if backend == "CPU":
        cycles.device = "CPU"
        return Device(backend="CPU", names=found["CPU"])
    preferences = _cycles_preferences()
    preferences.compute_device_type = backend
    for device in preferences.get_devices_for_type(backend):
        device.use = device.type == backend  # never mix CPU and GPU: tiles would differ between machines
    cycles.device = "GPU"
    used = tuple(d.name for d in preferences.get_devices_for_type(backend) if d.use)
    if preferences.compute_device_type != backend or not used:
        raise DeviceError(f"--device {request}: Cycles would not switch to {backend}")
    return Device(backend=backend, names=used)


def _cycles_preferences() -> Any:
    """Cycles' own preferences, with the device list filled (it is empty until it is asked for)."""
    preferences = bpy.context.preferences.addons["cycles"].preferences
    preferences.get_devices()
    return preferences
