"""What pip installs is the whole project: it works in an empty folder, without a checkout."""

import json
import zipfile
from email.parser import Parser

import pytest

from tests.packaging.built_wheel import (
    PACKAGES,
    ROOT,
    build_wheel,
    installed_environment,
    run_in,
    site_packages,
)

SMALL = """
extends: tiny
name: one_small_motion
plan: {motions: 1, motions_per_shard: 1}
sampling:
  clip: {n_frames: 2}
  cameras: {n_cameras: 1, image_size: [64, 64]}
  render: {samples: 4}
"""


@pytest.fixture(scope="session")
def wheel(tmp_path_factory):
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="session")
def binaries(wheel, tmp_path_factory):
    """Commands and Python of an environment with the wheel; libraries are those of the environment that tests."""
    environment = tmp_path_factory.mktemp("installed") / "env"
    return installed_environment(environment, wheel, libraries=site_packages()).parent


def test_every_file_of_the_packages_is_in_it(wheel):
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    expected = set()
    for package in PACKAGES:
        files = (
            path for path in (ROOT / package).rglob("*") if path.is_file() and "__pycache__" not in path.parts
        )
        expected |= {str(path.relative_to(ROOT)) for path in files}
        presets = ROOT / "configs" / package
        expected |= {f"{package}/presets/{path.name}" for path in presets.glob("*.yaml")}
    assert inside == expected
    assert {f"{package}/py.typed" for package in PACKAGES} <= inside


def test_its_metadata(wheel):
    archive = zipfile.ZipFile(wheel)
    folder = f"{'-'.join(wheel.stem.split('-')[:2])}.dist-info"
    metadata = Parser().parsestr(archive.read(f"{folder}/METADATA").decode())
    assert metadata["Requires-Python"] == ">=3.11"
    assert metadata["License-Expression"] == "Apache-2.0"
    assert {"datagen", "model"} <= set(metadata.get_all("Provides-Extra", []))
    required = [text for text in metadata.get_all("Requires-Dist", []) if "extra ==" not in text]
    assert {text.split(">")[0] for text in required} == {"numpy", "pyarrow", "OpenEXR", "fsspec"}
    assert {f"{folder}/licenses/LICENSE", f"{folder}/licenses/NOTICE"} <= set(archive.namelist())
    scripts = archive.read(f"{folder}/entry_points.txt").decode()
    assert "datagen = datagen.__main__:main" in scripts
    assert "forehoi = model.__main__:main" in scripts


def test_the_commands_work_in_an_empty_folder(binaries, tmp_path):
    code = "import datagen, model, shards; print(*(m.__file__ for m in (datagen, model, shards)))"
    imported = run_in(tmp_path, binaries / "python", "-c", code).stdout.split()
    assert imported == [
        str(site_packages(binaries.parent) / package / "__init__.py")
        for package in ("datagen", "model", "shards")
    ]

    planned = run_in(tmp_path, binaries / "datagen", "plan", "--config", "tiny")
    assert planned.returncode == 0, planned.stderr
    dataset = json.loads((tmp_path / "data" / "tiny" / "dataset.json").read_text())
    assert dataset["record"]["provenance"]["generator_commit"].startswith(
        "forehoi-open "
    )  # there is no checkout

    helped = run_in(tmp_path, binaries / "forehoi", "--help")
    assert helped.returncode == 0, helped.stderr
    assert "reconstruct" in helped.stdout

    unknown = run_in(tmp_path, binaries / "forehoi", "train", "tny")
    assert unknown.returncode == 2
    assert "did you mean 'tiny'?" in unknown.stderr


@pytest.mark.slow
@pytest.mark.blender
def test_it_renders(binaries, tmp_path):
    (tmp_path / "own.yaml").write_text(SMALL)
    done = run_in(
        tmp_path, binaries / "datagen", "render", "--config", "own.yaml", "--shard", "0", "--device", "cpu"
    )
    assert done.returncode == 0, done.stderr
    verified = run_in(tmp_path, binaries / "datagen", "verify", "data/own")
    assert verified.returncode == 0, verified.stdout + verified.stderr
    assert "1 clips, 2 frames" in verified.stdout
