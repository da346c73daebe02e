"""Does Blender's Python module load here? If not: what to install, down to the Debian packages."""

import ctypes
import re
import sys

__all__ = ["blender_import_problem", "check_blender", "missing_packages", "packages_of"]

# bpy opens windows nowhere in this project, but it is linked against the window system.
DEBIAN_PACKAGE_OF = {
    "libXrender.so.1": "libxrender1",
    "libXi.so.6": "libxi6",
    "libXfixes.so.3": "libxfixes3",
    "libxkbcommon.so.0": "libxkbcommon0",
    "libXxf86vm.so.1": "libxxf86vm1",
    "libSM.so.6": "libsm6",
    "libICE.so.6": "libice6",
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libGL.so.1": "libgl1",
    "libGLX.so.0": "libglx0",
    "libEGL.so.1": "libegl1",
}
_NEEDED = ("libXrender.so.1", "libXi.so.6", "libXfixes.so.3", "libxkbcommon.so.0", "libSM.so.6", "libGL.so.1")


def missing_packages() -> list[str]:
    """Debian packages to install before `import bpy` can work; empty when all is there (or not Linux)."""
    missing = []
    for library in _NEEDED if sys.platform == "linux" else ():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(DEBIAN_PACKAGE_OF[library])
    return missing


def packages_of(message: str) -> list[str]:
    """Debian packages of the libraries named in an ImportError's message."""
    libraries = re.findall(r"lib[\w+-]+\.so[.\d]*", message)
    return [DEBIAN_PACKAGE_OF[name] for name in dict.fromkeys(libraries) if name in DEBIAN_PACKAGE_OF]


def blender_import_problem() -> str | None:
    """Why `import bpy` fails here and what to do about it, in one line; None when it works."""
    packages = missing_packages()
    if not packages:
        try:
            import bpy  # noqa: F401
        except ModuleNotFoundError:
            return _no_module()
        except ImportError as error:
            packages = packages_of(str(error))
            if not packages:
                return f"Blender's module does not load: {error}; install it anew: pip install --force-reinstall bpy"
        else:
            return None
    return (
        "Blender's module needs system libraries that are missing; install them with: "
        f"apt-get install --no-install-recommends {' '.join(packages)}"
    )


def _no_module() -> str:
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    if version != "3.11":
        return (
            f"Blender's module exists for Python 3.11 only, this is {version}; make the environment with 3.11"
        )
    return (
        "Blender's module is not installed; expected the extra 'datagen': pip install 'forehoi-open[datagen]'"
    )


def check_blender() -> int:
    """Print Blender's version and devices, or what to install; the exit status, 0 or 2."""
    problem = blender_import_problem()
    if problem is not None:
        sys.stderr.write(f"{problem}\n")
        return 2
    import bpy

    from datagen.blender.devices import found_devices

    sys.stdout.write(f"bpy {bpy.app.version_string}\n")
    for backend, names in found_devices().items():
        sys.stdout.write(f"{backend.lower()}: {', '.join(names)}\n")
    return 0
