"""Reading needs NumPy, pyarrow, OpenEXR and fsspec: nothing more is imported, NumPy 1 or 2, any Python from 3.11."""

import re
import shutil
import subprocess
import sys
import venv
from pathlib import Path

import pytest

from tests.packaging.built_wheel import build_wheel, run_in

ROOT = Path(__file__).parents[2]
README = ROOT / "shards" / "README.md"
FOREIGN = ("bpy", "torch", "scipy", "jaxtyping", "beartype", "PIL", "cv2", "trimesh", "yaml", "click", "rich")

BLOCK_AND_READ = f"""
import sys
for name in {FOREIGN!r}:
    sys.modules[name] = None
from shards.errors import ImageError
from shards.storage.images import decode_rgb
from shards.reader import open_dataset
from shards.verify import verify_dataset
dataset = open_dataset(sys.argv[1])
frame = dataset.read_frames("motion-000000-camera-00").frame(0)
assert frame.rgb.shape == (40, 40, 3) and frame.geometry.depth.max() > 0.1
assert all(report.ok for report in verify_dataset(sys.argv[1]))
try:
    decode_rgb(b"\\xff\\xd8\\xff\\xe0 a JPEG")
except ImageError as error:
    assert "need Pillow" in str(error) and "pip install pillow" in str(error)
else:
    raise SystemExit("a JPEG was decoded without Pillow")
import numpy
print("read with NumPy", numpy.__version__)
"""


def run(python: str, code: str, *arguments: object) -> str:
    command = [python, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def readme_example(name: str, dataset_dir: Path) -> str:
    code = re.search(
        rf"<!-- example: {name} -->\n```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL
    )
    assert code is not None
    return code[1].replace("data/tiny", str(dataset_dir))


NEWEST = ("numpy>=2", "pyarrow", "OpenEXR")
OLDEST = ("numpy==1.26.*", "pyarrow==17.*", "OpenEXR==3.5.0")  # what pyproject.toml allows

CHECK_PLAIN = """
assert np.abs(joints_px - np.array(frames.read_row_group(index)["joints_px"].to_pylist()[-1])).max() < 0.01
assert depth.shape == depth_object.shape == (40, 40) and 0.4 < depth_object.max() < 0.8
"""


def test_reading_imports_nothing_foreign(dataset_dir):
    assert "read with NumPy" in run(sys.executable, BLOCK_AND_READ, dataset_dir)


def test_the_geometry_module_costs_numpy_alone():
    code = "import sys, shards.geometry; print({'pyarrow', 'OpenEXR', 'fsspec'} & sys.modules.keys())"
    assert run(sys.executable, code).strip() == "set()"


def test_the_readme_examples_run(dataset_dir):
    run(sys.executable, readme_example("plain", dataset_dir) + CHECK_PLAIN)
    run(sys.executable, readme_example("package", dataset_dir))


def test_the_plain_example_is_short():
    code = readme_example("plain", Path())
    assert len([line for line in code.splitlines() if line.strip()]) <= 15


@pytest.mark.slow
@pytest.mark.parametrize("requirements", [NEWEST, OLDEST], ids=["newest", "oldest"])
def test_a_fresh_environment_with_four_packages_reads(dataset_dir, tmp_path, requirements):
    venv.create(tmp_path / "env", with_pip=True)
    python = str(tmp_path / "env/bin/python")
    subprocess.run([python, "-m", "pip", "install", "-q", "fsspec", *requirements], check=True)
    version = 2 if requirements is NEWEST else 1
    assert f"read with NumPy {version}." in run(python, BLOCK_AND_READ, dataset_dir)
    run(python, readme_example("plain", dataset_dir) + CHECK_PLAIN)


def interpreter(minor: int) -> str | None:
    """A Python 3.`minor` of this machine that runs: on the path, or among those of pyenv."""
    name, pyenv = f"python3.{minor}", Path.home() / ".pyenv" / "versions"
    for python in (shutil.which(name), *map(str, sorted(pyenv.glob(f"3.{minor}.*/bin/{name}")))):
        # One of pyenv's shims is there for every version, and runs only the chosen one.
        if python and subprocess.run([python, "-c", ""], capture_output=True, check=False).returncode == 0:
            return python
    return None


@pytest.mark.slow
@pytest.mark.parametrize("minor", [11, 12, 13, 14])
def test_the_wheel_alone_reads_on_every_python(dataset_dir, tmp_path, minor):
    base = interpreter(minor)
    if base is None:
        pytest.skip(f"Python 3.{minor} is not on this machine")
    subprocess.run([base, "-m", "venv", str(tmp_path / "env")], check=True)
    python = tmp_path / "env" / "bin" / "python"
    wheel = build_wheel(tmp_path / "wheel")
    subprocess.run([python, "-m", "pip", "install", "-q", str(wheel)], check=True)
    where = run_in(
        tmp_path, python, "-c", "import sys, shards; print(sys.version_info.minor, shards.__file__)"
    )
    found, file = where.stdout.split()
    assert int(found) == minor
    assert Path(file).is_relative_to(tmp_path / "env")
    read = run_in(tmp_path, python, "-c", BLOCK_AND_READ, dataset_dir)
    assert "read with NumPy" in read.stdout, read.stderr
