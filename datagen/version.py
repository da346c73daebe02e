"""Which code made the data."""

import subprocess
from importlib.metadata import version
from pathlib import Path

__all__ = ["generator_commit"]

ROOT = Path(__file__).resolve().parents[1]


def generator_commit() -> str:
    """The git commit of this checkout, '+' when files differ from it.

    The version of the package where there is no checkout, no git, or no commit that git would tell.
    """
    if (ROOT / ".git").exists():
        commit, changes = _git("rev-parse", "HEAD"), _git("status", "--porcelain", "--untracked-files=no")
        if commit is not None and changes is not None:
            return commit + ("+" if changes else "")
    return f"forehoi-open {version('forehoi-open')}"


def _git(*arguments: str) -> str | None:
    """Output of a git command in this checkout; None when git is not installed or refuses."""
    try:
        done = subprocess.run(
            ["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True
        )
    except (FileNotFoundError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
