"""Benchmarks print one line per claim; run them with `make bench`."""

import pytest


@pytest.fixture
def say(capsys):
    """Print past pytest's capture."""

    def print_line(text: str) -> None:
        with capsys.disabled():
            print(f"\n{text}", end="", flush=True)

    return print_line
