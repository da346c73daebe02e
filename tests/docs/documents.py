"""The texts of the repository, for the tests of this folder."""

import re
import subprocess
from pathlib import Path

__all__ = ["ROOT", "code_blocks", "file_names", "text_files"]

ROOT = Path(__file__).resolve().parents[2]


def file_names() -> list[str]:
    """Everything that belongs to the checkout, relative to its root: tracked, or new and not ignored."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [name for name in listed.splitlines() if (ROOT / name).is_file()]


def text_files(*suffixes: str) -> dict[str, str]:
    """Name and text of all files with these suffixes."""
    return {
        name: (ROOT / name).read_text(encoding="utf-8") for name in file_names() if name.endswith(suffixes)
    }


def code_blocks(text: str, language: str) -> list[str]:
    """Contents of the fenced blocks of one language; the empty language is that of a plain fence."""
    return [block for tag, block in re.findall(r"^```(\w*)\n(.*?)^```", text, re.M | re.S) if tag == language]
