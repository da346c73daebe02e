"""What files are called, on one line of a terminal."""

import os

import pytest

from shards.printable import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("größe 杯子[1].png", "größe 杯子[1].png"),
        ("two\nlines\r\x1b[31m", r"two\nlines\r\x1b[31m"),
        (os.fsdecode(b"caf\xe9.png"), r"caf\udce9.png"),
        ("\ud800", r"\ud800"),
        ("", ""),
    ],
)
def test_one_line_that_any_terminal_takes(text, shown):
    assert printable(text) == shown
    assert printable(text).isprintable()
