"""Every image is opened with the formats that are expected there: Pillow starts Ghostscript for what says EPS."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def opened_as_anything(source: str) -> list[int]:
    """Lines with an `Image.open` that names no formats."""
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    return [
        call.lineno
        for call in calls
        if isinstance(call.func, ast.Attribute)
        and call.func.attr == "open"
        and isinstance(call.func.value, ast.Name)
        and call.func.value.id in ("Image", "PIL")
        and "formats" not in [keyword.arg for keyword in call.keywords]
    ]


@pytest.mark.parametrize("folder", ["shards", "datagen", "model", "blender_scripts"])
def test_formats_are_always_named(folder):
    found = {str(path): opened_as_anything(path.read_text()) for path in (ROOT / folder).rglob("*.py")}
    assert {path: lines for path, lines in found.items() if lines} == {}


def test_a_bare_call_is_seen():
    assert opened_as_anything("x = 1\nImage.open(path)") == [2]
    assert opened_as_anything("Image.open(path, formats=FORMATS)\nopen(path)") == []
