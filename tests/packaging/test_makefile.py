"""`make` finds a Python for Blender, or says in one line how to get one."""

import os
import shutil
import subprocess
import sys

import pytest

from tests.packaging.built_wheel import ROOT

MAKE, UV = shutil.which("make"), shutil.which("uv")
pytestmark = pytest.mark.skipif(MAKE is None, reason="needs make")


def make_environment(folder, *settings, path=None):
    """`make .venv/bin/python` in an empty folder; with `path` as PATH."""
    folder.mkdir(exist_ok=True)
    env = os.environ | {"PATH": str(path)} if path else dict(os.environ)
    env.pop("PYTHON", None)
    command = [MAKE, "-f", str(ROOT / "Makefile"), ".venv/bin/python", *settings]
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)


@pytest.fixture
def tools(tmp_path):
    """A PATH that has a Python of ours, but not under the name python3.11."""
    folder = tmp_path / "tools"
    folder.mkdir()
    (folder / "python3").symlink_to(sys.executable)
    return folder


def test_without_python_3_11_and_uv_one_line_says_how(tmp_path, tools):
    done = make_environment(tmp_path / "work", path=tools)
    assert done.returncode != 0
    line, makes_own = done.stderr.splitlines()
    assert line.startswith("make: python3.11 is no Python 3.11 that can make environments")
    assert "pipx install uv" in line
    assert "PYTHON=/path/to/python3.11" in line
    assert "Error 2" in makes_own
    assert not (tmp_path / "work" / ".venv").exists()


def test_a_named_python_is_used_or_refused(tmp_path):
    named = make_environment(tmp_path / "named", f"PYTHON={sys.executable}")
    is_3_11 = sys.version_info[:2] == (3, 11)
    assert (named.returncode == 0) == is_3_11
    assert (tmp_path / "named" / ".venv" / "bin" / "pip").exists() == is_3_11
    missing = make_environment(tmp_path / "missing", "PYTHON=/nowhere/python")
    assert "/nowhere/python is no Python 3.11" in missing.stderr


@pytest.mark.skipif(UV is None or sys.version_info[:2] != (3, 11), reason="needs uv and a Python 3.11")
def test_uv_is_used_where_no_python3_11_is_named(tmp_path, tools):
    (tools / "uv").symlink_to(UV)
    done = make_environment(tmp_path / "work", path=tools)
    assert done.returncode == 0, done.stderr
    assert "with uv" in done.stdout
    python = tmp_path / "work" / ".venv" / "bin" / "python"
    version = subprocess.run(
        [python, "-m", "pip", "--version"], capture_output=True, text=True, check=True
    ).stdout
    assert "(python 3.11)" in version
