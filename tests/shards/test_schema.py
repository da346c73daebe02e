"""The schema is stated once, and everything made from it agrees."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shards.column_tables import update_readme
from shards.columns import arrow_schema, columns_of, rows_from_table, table_from_rows
from shards.errors import RowError
from shards.schema import ROW_TYPES, ObjectRow
from tests.shards.synthetic import synthetic_clip, synthetic_object

README = Path(__file__).parents[2] / "shards" / "README.md"


def test_readme_tables_are_up_to_date():
    text = README.read_text(encoding="utf-8")
    assert update_readme(text) == text, "run: python -m shards.column_tables shards/README.md"


@pytest.mark.parametrize("row_type", ROW_TYPES.values())
def test_annotations_and_columns_say_the_same(row_type):
    scalar = {"string": str, "bool": bool, "int32": int, "int64": int, "float32": float, "float64": float}
    kinds = {"f": "Float", "i": "Int", "u": "UInt8"}
    for c, field in zip(columns_of(row_type), dataclasses.fields(row_type)):
        if not c.shape:
            expected = {"binary": bytes | None if c.nullable else bytes}.get(c.dtype) or scalar[c.dtype]
            assert field.type == expected, c.name
        else:
            assert field.type.dim_str == " ".join(map(str, c.shape)), c.name
            assert field.type.__name__.startswith(kinds[np.dtype(c.dtype).kind]), c.name


@pytest.mark.parametrize("row_type", ROW_TYPES.values())
def test_every_column_is_explained_in_the_file_itself(row_type):
    for field in arrow_schema(row_type):
        assert field.metadata[b"meaning"].endswith(b".") or b"." in field.metadata[b"meaning"], field.name
        assert {b"unit", b"frame"} <= field.metadata.keys()


BALL = synthetic_object(0)


def rows() -> dict[str, list[Any]]:
    object_row = synthetic_object(0, mesh=False)
    clip, frames = synthetic_clip(object_row, 0, 0, 2, 24)
    return {"objects": [object_row, synthetic_object(1)], "clips": [clip], "frames": frames}


@pytest.mark.parametrize("name", ROW_TYPES)
def test_rows_come_back_as_they_were(name):
    row_type: type[Any] = ROW_TYPES[name]
    before = rows()[name]
    after = rows_from_table(table_from_rows(before, row_type, where=name), row_type, where=name)
    for old, new in zip(before, after, strict=True):
        for c in columns_of(row_type):
            a, b = getattr(old, c.name), getattr(new, c.name)
            if c.shape:
                assert b.dtype == c.dtype
                np.testing.assert_array_equal(np.asarray(a).astype(c.dtype), b)
            elif c.dtype == "float32":
                np.testing.assert_equal(np.float32(a), np.float32(b))
            else:
                np.testing.assert_equal(a, b)


@given(st.lists(st.integers(0, 5), max_size=4), st.randoms(use_true_random=False))
def test_columns_of_varying_length_keep_their_rows(lengths, random):
    voxels = [np.full((n, 3), random.randrange(64), np.uint8) for n in lengths]
    table = table_from_rows([dataclasses.replace(BALL, occupancy_64=v) for v in voxels], ObjectRow, where="t")
    table.validate(full=True)
    for old, new in zip(voxels, rows_from_table(table, ObjectRow, where="t"), strict=True):
        np.testing.assert_array_equal(old, new.occupancy_64)


@given(hnp.arrays(np.float64, (4, 4), elements=st.floats(-1e3, 1e3)))
def test_transforms_are_stored_exactly(T):
    row = dataclasses.replace(BALL, occupancy_64=BALL.occupancy_64[:3], T_objmesh_from_canonical=T)
    (back,) = rows_from_table(table_from_rows([row], ObjectRow, where="t"), ObjectRow, where="t")
    np.testing.assert_array_equal(back.T_objmesh_from_canonical, T)


def test_tables_hold_plain_nested_lists():
    table = table_from_rows(rows()["clips"], ROW_TYPES["clips"], where="clips")
    assert np.array(table["K"].to_pylist()).shape == (1, 3, 3)
    assert table.schema.field("light_position_world").type == pa.list_(
        pa.field("element", pa.list_(pa.field("element", pa.float32(), nullable=False), 3), nullable=False)
    )


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        (
            "frames",
            {"hand_object_distance_m": np.nan},
            "column 'hand_object_distance_m': not a finite number",
        ),
        ("frames", {"hand_object_distance_m": 1e300}, "not a finite number"),
        ("frames", {"joints_px": np.full((21, 2), np.inf)}, "joints_px.*42 of 42"),
        ("frames", {"rgb": None}, "rgb.*expected binary, found NoneType"),
        ("clips", {"split": "dev"}, "split.*unknown value.*'train', 'val', 'test'.*found 'dev'"),
        ("clips", {"n_frames": 2**40}, "n_frames.*out of range"),
        ("clips", {"K": np.eye(4)}, "'K': wrong shape.*expected \\(3, 3\\), found \\(4, 4\\)"),
        ("clips", {"betas": np.array(["a"])}, "betas.*wrong dtype"),
        (
            "clips",
            {"light_power_w": np.ones(1)},
            "light_power_w.*number of 'light'.*expected 2, found 1",
        ),
        ("clips", {"hand_side": b"left"}, "hand_side.*expected string, found bytes"),
    ],
)
def test_a_value_that_does_not_fit_names_row_and_column(name, change, message):
    good = rows()[name][0]
    bad = object.__new__(type(good))  # as in production, where annotations are not checked
    bad.__dict__.update(good.__dict__ | change)
    with pytest.raises(RowError, match=rf"{name}.parquet, row 0, .*{message}"):
        table_from_rows([bad], ROW_TYPES[name], where=f"{name}.parquet")
