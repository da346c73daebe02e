"""A command without its libraries says in one line which extra brings them."""

import sys
import venv

import pytest

from shards.commands.extras import needs_extra
from tests.packaging.built_wheel import ROOT, run_in, site_packages

COMMANDS = [("datagen", "datagen", "datagen"), ("model", "forehoi", "model")]


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """A Python with the standard library alone."""
    folder = tmp_path_factory.mktemp("bare")
    venv.create(folder, with_pip=False, symlinks=True)
    return folder / "bin" / "python"


def without(library, folder):
    """A Python that has all libraries of this one but `library`."""
    libraries = folder / "libraries"
    libraries.mkdir()
    for path in site_packages().iterdir():
        if path.name != library and path.suffix != ".pth":
            (libraries / path.name).symlink_to(path)
    venv.create(folder / "env", with_pip=False, symlinks=True)
    (site_packages(folder / "env") / "libraries.pth").write_text(f"{libraries}\n")
    return folder / "env" / "bin" / "python"


@pytest.mark.parametrize(("module", "program", "extra"), COMMANDS)
def test_an_environment_without_the_extra(bare, tmp_path, module, program, extra):
    done = run_in(tmp_path, bare, "-m", module, "--help", path=ROOT)
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"{program}: the Python package '")
    assert f"pip install 'forehoi-open[{extra}]'" in line


@pytest.mark.parametrize(("module", "library"), [("datagen", "mujoco"), ("model", "accelerate")])
def test_a_single_library_that_is_missing_is_named(tmp_path, module, library):
    done = run_in(tmp_path, without(library, tmp_path), "-m", module, "--help", path=ROOT)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f"the Python package '{library}' is not installed" in line


def test_the_renderer_without_blender_says_so_in_one_line(bare, tmp_path):
    done = run_in(tmp_path, bare, "-m", "datagen.blender", path=ROOT)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "extra 'datagen'" in line if sys.version_info[:2] == (3, 11) else "Python 3.11 only" in line


@pytest.mark.parametrize("code", ["import json.nothing", "raise ModuleNotFoundError('no name')"])
def test_a_bug_stays_a_bug(code):
    with pytest.raises(ModuleNotFoundError), needs_extra("tool", "extra", make="all"):
        exec(code)
