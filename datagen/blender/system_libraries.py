"""System libraries that Blender's Python module links to, and the Debian packages that hold them."""

import ctypes
import re
import sys

__all__ = ["blender_import_problem", "missing_packages", "packages_of"]

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
    """Why `import bpy` fails here and what to do about it; None when it works."""
    packages = missing_packages()
    if not packages:
        try:
            import bpy  # noqa: F401
        except ImportError as error:
            packages = packages_of(str(error))
            if not packages:
                fix = "Install it with: pip install 'bpy==4.5.*' (Python 3.11)"
                return f"Blender's module does not load: {error}\n{fix}"
        else:
            return None
    return (
        "Blender's module needs system libraries that are missing.\n"
        f"Install them with: apt-get install --no-install-recommends {' '.join(packages)}"
    )
