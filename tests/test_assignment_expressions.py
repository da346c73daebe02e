"""`a or (b := ...)` leaves b unbound where a is true, and mypy's check of unbound names does not look there."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("shards", "datagen", "model", "tests", "docs", "blender_scripts")


def bound_sometimes(source: str) -> list[tuple[str, int]]:
    """Names that are assigned right of an `or`, and their lines."""
    return [
        (inner.target.id, inner.lineno)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.BoolOp) and isinstance(node.op, ast.Or)
        for operand in node.values[1:]
        for inner in ast.walk(operand)
        if isinstance(inner, ast.NamedExpr)
    ]


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_name_is_assigned_right_of_an_or(folder):
    found = {path: bound_sometimes(path.read_text()) for path in sorted((ROOT / folder).rglob("*.py"))}
    assert found
    assert {str(path): names for path, names in found.items() if names} == {}


def test_it_is_seen_where_it_is_and_only_there():
    assert bound_sometimes("if a or (b := f()):\n    print(b)") == [("b", 1)]
    assert bound_sometimes("if (b := f()) or a:\n    print(b)") == []
    assert bound_sometimes("if a and (b := f()):\n    print(b)") == []
