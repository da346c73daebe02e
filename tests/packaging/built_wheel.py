"""The wheel of this checkout, and environments in which nothing but the wheel is ours."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

__all__ = ["PACKAGES", "ROOT", "build_wheel", "installed_environment", "run_in", "site_packages"]

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("shards", "datagen", "model")
_LEFTOVERS = shutil.ignore_patterns("__pycache__", "*.egg-info")


def build_wheel(folder: Path) -> Path:
    """Built from a copy: setuptools leaves a build folder beside the sources, and takes up what lies in one."""
    source = folder / "source"
    for name in (*PACKAGES, "configs"):
        shutil.copytree(ROOT / name, source / name, symlinks=True, ignore=_LEFTOVERS)
    for name in ("pyproject.toml", "README.md", "LICENSE", "NOTICE"):
        shutil.copy(ROOT / name, source / name)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--wheel-dir", str(folder), str(source)], check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def installed_environment(folder: Path, wheel: Path, *, libraries: Path | None) -> Path:
    """The Python of a new environment with the wheel, without its dependencies.

    `libraries`: a folder from which other packages are imported, after the environment's own.
    """
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--quiet", "--python", str(python), "install"]
    subprocess.run([*pip, "--no-deps", "--no-index", str(wheel)], check=True)
    if libraries is not None:
        (site_packages(folder) / "libraries.pth").write_text(f"{libraries}\n")
    return python


def site_packages(environment: Path | None = None) -> Path:
    """Where an environment, or this one, keeps its packages."""
    variables = None if environment is None else {"base": str(environment), "platbase": str(environment)}
    return Path(sysconfig.get_path("purelib", vars=variables))


def run_in(cwd: Path, *command: str | Path, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command elsewhere than in the checkout, with `path` as PYTHONPATH."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    env = kept if path is None else {**kept, "PYTHONPATH": str(path)}
    return subprocess.run([*map(str, command)], cwd=cwd, env=env, capture_output=True, text=True, check=False)
