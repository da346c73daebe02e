"""A missing system library must end in the name of a Debian package."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from datagen.blender.system_libraries import packages_of

CHECK = Path(__file__).parents[3] / "blender_scripts" / "check_blender.py"


@pytest.mark.blender
def test_check_reports_version_and_devices():
    done = subprocess.run([sys.executable, CHECK], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("bpy 4.5")
    assert "cpu: " in done.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="the dynamic linker of Linux")
def test_a_library_the_linker_cannot_load_is_named_as_a_package(tmp_path):
    # An empty file found first is as good as no file: the real linker fails for real.
    for library in ("libXrender.so.1", "libSM.so.6"):
        (tmp_path / library).write_bytes(b"")
    env = {**os.environ, "LD_LIBRARY_PATH": str(tmp_path)}
    done = subprocess.run([sys.executable, CHECK], capture_output=True, text=True, env=env, timeout=120)
    assert done.returncode == 2
    assert "apt-get install --no-install-recommends libxrender1 libsm6" in done.stderr


def test_the_linkers_message_is_understood():
    message = "libxkbcommon.so.0: cannot open shared object file: No such file or directory"
    assert packages_of(message) == ["libxkbcommon0"]
    assert packages_of("undefined symbol: _ZN3foo") == []
