"""Impossible settings are refused when they are read, of datasets and of trainings: every number has a range."""

import copy
import types
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import pytest
import yaml

from datagen.config import DatasetConfig, config_as_yaml, read_config
from model.recipes.components.component_identity import as_yaml
from model.recipes.config import TrainingConfig, load_config, parse_config
from shards.settings import Range, SettingsError, settings_from_dict


def numbers(kind: Any, place: str = "", allowed: Range | None = None) -> Iterator[tuple[str, Range | None]]:
    """Each number that a configuration holds: where, and its range."""
    origin, arguments = get_origin(kind), get_args(kind)
    if is_dataclass(kind):
        hints = get_type_hints(kind, include_extras=True)
        for field in fields(kind):
            if field.init:
                yield from numbers(hints[field.name], f"{kind.__name__}.{field.name}")
    elif origin is Annotated:
        ranges = [extra for extra in arguments[1:] if isinstance(extra, Range)]
        yield from numbers(arguments[0], place, ranges[0] if ranges else None)
    elif origin in (Union, types.UnionType, tuple, dict):
        for argument in arguments:
            yield from numbers(argument, place, allowed)
    elif kind in (int, float):
        yield place, allowed


def test_every_number_has_a_range():
    found = [of for kind in (DatasetConfig, *get_args(TrainingConfig)) for of in numbers(kind)]
    assert len(found) > 250
    assert sorted({place for place, allowed in found if allowed is None}) == []


def leaves(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The places of all numbers of plain content."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield from leaves(value, (*path, key))
    if type(data) in (int, float):
        yield path


def with_value(data: Any, path: tuple[Any, ...], value: object) -> Any:
    changed = copy.deepcopy(data)
    at = changed
    for key in path[:-1]:
        at = at[key]
    at[path[-1]] = value
    return changed


DATASET = yaml.safe_load(config_as_yaml(read_config("tiny")))
TRAININGS = {name: yaml.safe_load(as_yaml(load_config(name))) for name in ("tiny", "tiny_slat", "paper")}


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e12, 1e200, 10**400, -(10**400)])
def test_no_number_of_a_dataset_may_be_anything(value):
    for path in leaves(DATASET):
        with pytest.raises(SettingsError) as caught:
            settings_from_dict(DatasetConfig, with_value(DATASET, path, value), where="own.yaml")
        assert len(str(caught.value)) < 500
        assert str(path[0]) in str(caught.value)


@pytest.mark.parametrize("name", TRAININGS)
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e12, 1e200, 10**400])
def test_no_number_of_a_training_may_be_anything(name, value):
    for path in leaves(TRAININGS[name]):
        changed = with_value(TRAININGS[name], path, value)
        with pytest.raises(SettingsError) as caught:
            parse_config(yaml.safe_dump(changed), where="own.yaml")
        assert len(str(caught.value)) < 1500  # a union says what fits none of its forms


@pytest.mark.parametrize(
    ("key", "value", "problem"),
    [
        ("sampling.cameras.n_cameras", -1, "between 1 and 1,000, found -1"),
        ("sampling.clip.n_frames", 0, "between 1 and 10,000, found 0"),
        ("sampling.cameras.image_size", [0, 0], "each between 16 and 8,192, found [0, 0]"),
        ("sampling.cameras.image_size", [100_000, 100_000], "each between 16 and 8,192"),
        ("sampling.render.samples", -3, "between 1 and 65,536"),
        ("split.val_fraction", float("nan"), "a finite number, found nan"),
        ("plan.motions", 0, "between 1 and 10,000,000"),
        ("grasp.mass_kg", [0.5, 0.03], "(lowest, highest), found [0.5, 0.03]"),
        ("sampling.lights.hdris", {"city": -1.0}, "each between 0 and 1,000"),
        ("seed", -1, "at least 0, found -1"),
    ],
)
def test_the_line_says_what_is_allowed(key, value, problem):
    path = tuple(key.split("."))
    with pytest.raises(SettingsError) as caught:
        settings_from_dict(DatasetConfig, with_value(DATASET, path, value), where="own.yaml")
    assert str(caught.value).startswith(f"own.yaml: '{key}': expected ")
    assert problem in str(caught.value)
