"""Keep Blender's own output away from ours, and find errors in it."""

import json
import os
import sys
import tempfile
from typing import IO, Any

__all__ = ["BlenderLog", "RenderError", "progress_channel"]

_ERROR_MARKS = ("error:", "render error", "out of memory", "cannot save", "failed to")
_HARMLESS = ("error: not freed memory",)  # of Blender's exit, counts nothing


class RenderError(RuntimeError):
    """Blender or Cycles reported an error while an image was made."""


class ProgressChannel:
    """One JSON object per line on the standard output the process was started with."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def send(self, event: str, **values: Any) -> None:
        """Write one event at once."""
        self._stream.write(json.dumps({"event": event, **values}) + "\n")
        self._stream.flush()


class BlenderLog:
    """What Blender prints on standard output, kept in a file and searched for errors."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def check(self, what: str) -> None:
        """Raise RenderError when Blender printed an error since the last call; then forget the text."""
        text = self._take()
        errors = [line.strip() for line in text.splitlines() if _is_error(line)]
        if errors:
            raise RenderError(f"{what}: Blender says: {'; '.join(dict.fromkeys(errors))}")

    def _take(self) -> str:
        self._file.seek(0)
        text = self._file.read().decode(errors="replace")
        self._file.seek(0)
        self._file.truncate()
        return text


def progress_channel() -> tuple[ProgressChannel, BlenderLog]:
    """Take over standard output: ours stays clean, everything else goes to the log.

    Works on the file descriptor, because Blender prints from C.
    """
    sys.stdout.flush()
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    log = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - lives as long as the process
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(log.fileno(), 1)
    return ProgressChannel(channel), BlenderLog(log)


def _is_error(line: str) -> bool:
    lower = line.lower()
    return any(mark in lower for mark in _ERROR_MARKS) and not any(mark in lower for mark in _HARMLESS)
