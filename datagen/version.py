"""Which code made the data."""

import subprocess
from importlib.metadata import version
from pathlib import Path

__all__ = ["generator_commit"]


def generator_commit() -> str:
    """The git commit of this checkout, '+' when files differ from it; else the package version."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return f"forehoi-open {version('forehoi-open')}"
    commit = subprocess.run(
        ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    )
    if commit.returncode != 0:  # a checkout without a commit, or without git
        return f"forehoi-open {version('forehoi-open')}"
    changed = subprocess.run(
        ["git", "-C", str(root), "status", "--porcelain", "--untracked-files=no"],
        capture_output=True,
        text=True,
        check=True,
    )
    return commit.stdout.strip() + ("+" if changed.stdout.strip() else "")
