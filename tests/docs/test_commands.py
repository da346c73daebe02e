"""Command lines in the texts can be typed as they stand, and no command is left out of the README."""

import re
import shlex

import click
import pytest

from datagen.cli.main import main as datagen
from model.cli.main import main as forehoi
from tests.docs.documents import ROOT, code_blocks, text_files

PROGRAMS: dict[str, click.Command] = {"datagen": datagen, "forehoi": forehoi}
TEXTS = ("README.md", "CONTRIBUTING.md", "docs/README.md", "model/encoders/data/README.md")


def command_paths(command: click.Command, path: str) -> list[str]:
    if not isinstance(command, click.Group):
        return [path]
    return [
        leaf for name, inner in command.commands.items() for leaf in command_paths(inner, f"{path} {name}")
    ]


@pytest.mark.parametrize(
    "path", [leaf for name, main in PROGRAMS.items() for leaf in command_paths(main, name)]
)
def test_every_command_is_in_the_readme(path):
    words = re.sub(r" +", " ", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert path in words


def command_lines() -> list[tuple[str, str]]:
    """(text, command line) of the plain blocks, without comments, loops and the folder of the program."""
    found = []
    for name in TEXTS:
        for line in "\n".join(code_blocks((ROOT / name).read_text(encoding="utf-8"), "")).splitlines():
            match = re.search(
                r"(?:^|\bdo )(?:\.venv/bin/)?((?:datagen|forehoi) [^;#]*?)\s*(?:;|  +#|$)", line
            )
            if match:
                found.append((name, match[1]))
    return found


@pytest.mark.parametrize(("name", "line"), command_lines())
def test_every_command_line_is_understood(name, line):
    program, *words = shlex.split(line.replace("$shard", "1"))
    command: click.Command = PROGRAMS[program]
    while isinstance(command, click.Group):
        command = command.commands[words.pop(0)]
    command.make_context(line, words)  # raises for options and arguments that it does not know


def test_every_target_of_make_exists():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = {
        (name, target)
        for name, text in text_files(".md").items()
        for target in re.findall(r"(?:^|`)make ([a-z][a-z-]*)", text, re.MULTILINE)
    }
    assert ("README.md", "render") in named
    assert [(name, target) for name, target in named if target not in targets] == []
