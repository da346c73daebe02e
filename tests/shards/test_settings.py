"""Settings are read strictly, and every refusal says where and what to do."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest

from shards.settings import SettingsError, settings_from_dict


@dataclass(frozen=True, kw_only=True)
class Lamp:
    power_w: float
    kind: Literal["area", "spot"]


@dataclass(frozen=True, kw_only=True)
class Fog:
    density: float


@dataclass(frozen=True, kw_only=True)
class Stage:
    name: str
    lamps: tuple[Lamp, ...]
    size_m: tuple[float, float]
    folder: Path
    seed: int | None
    enabled: bool
    weather: Lamp | Fog
    extra: dict[str, Any]
    samples: int = 16

    def __post_init__(self) -> None:
        if self.size_m[0] > self.size_m[1]:
            raise ValueError(f"size_m must rise, found {self.size_m}")


def good() -> dict[str, Any]:
    return {
        "name": "studio",
        "lamps": [{"power_w": 40, "kind": "area"}],
        "size_m": [1, 2.5],
        "folder": "some/where",
        "seed": None,
        "enabled": True,
        "weather": {"density": 0.1},
        "extra": {"anything": [1, "x"]},
    }


def test_a_complete_mapping_becomes_typed_settings():
    stage = settings_from_dict(Stage, good(), "a.yaml")
    assert stage == Stage(
        name="studio",
        lamps=(Lamp(power_w=40.0, kind="area"),),
        size_m=(1.0, 2.5),
        folder=Path("some/where"),
        seed=None,
        enabled=True,
        weather=Fog(density=0.1),
        extra={"anything": [1, "x"]},
    )
    assert isinstance(stage.lamps[0].power_w, float)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nmae": "x"}, "a.yaml: unknown key 'nmae' (did you mean 'name'?)"),
        ({"lamps": [{"power": 1, "kind": "area"}]}, "unknown key 'lamps[0].power' (did you mean 'power_w'?)"),
        ({"lamps": [{}]}, "missing keys 'lamps[0].power_w', 'lamps[0].kind'"),
        ({"lamps": {}}, "'lamps': expected a list, found {}"),
        ({"lamps": [{"power_w": "40", "kind": "area"}]}, "'lamps[0].power_w': expected a number, found '40'"),
        (
            {"lamps": [{"power_w": 1, "kind": "spto"}]},
            "expected one of 'area', 'spot', found 'spto' (did you mean 'spot'?)",
        ),
        ({"size_m": [1.0]}, "'size_m': expected a list of 2"),
        ({"size_m": [3, 1]}, "size_m must rise"),
        ({"seed": 1.5}, "'seed': expected a whole number, found 1.5"),
        ({"seed": True}, "'seed': expected a whole number, found True"),
        ({"enabled": "False"}, "'enabled': expected true or false, found 'False'"),
        ({"name": None}, "'name': expected text, found None"),
        ({"folder": 3}, "'folder': expected a path"),
        ({"weather": {"fog": 1}}, "'weather' fits none of its forms"),
        ({"extra": {1: 2}}, "'extra': expected a mapping with text keys"),
    ],
)
def test_refusals(change, message):
    with pytest.raises(SettingsError) as caught:
        settings_from_dict(Stage, good() | change, "a.yaml")
    text = str(caught.value)
    assert message in text
    assert text.startswith("a.yaml: ")
    assert "\n" not in text


def test_missing_keys_are_listed_but_defaults_are_not_required():
    data = good()
    del data["name"], data["folder"]
    with pytest.raises(SettingsError, match="missing keys 'name', 'folder'"):
        settings_from_dict(Stage, data, "a.yaml")


def test_a_file_that_is_no_mapping_is_refused():
    with pytest.raises(SettingsError, match=r"\(top level\).*expected a mapping, found \['a'\]"):
        settings_from_dict(Stage, ["a"], "a.yaml")


def test_a_programming_mistake_is_not_blamed_on_the_file():
    @dataclass(frozen=True, kw_only=True)
    class Odd:
        value: set[int]

    with pytest.raises(TypeError, match="does not understand"):
        settings_from_dict(Odd, {"value": [1]}, "a.yaml")
