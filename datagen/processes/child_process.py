"""Child processes that report by JSON lines on standard output and log on standard error.

A motion is rendered by a short-lived worker, and Blender runs in a child of that: memory
that leaks goes with the process, and a crash costs one motion, not the shard.
"""

import ctypes
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

__all__ = ["BAD_INPUT", "ChildError", "Event", "die_with_parent", "emit", "run_child"]

Event = dict[str, Any]

BAD_INPUT = 2  # exit status of a child that says in one line what the user got wrong
LOG_LINES_SHOWN = 12
PR_SET_PDEATHSIG = 1


class ChildError(RuntimeError):
    """A child process failed; carries its exit status and the end of its log."""

    def __init__(self, message: str, *, status: int, log: Path) -> None:
        super().__init__(message)
        self.status = status
        self.log = log


def emit(**event: Any) -> None:
    """Send one event to the parent process."""
    sys.stdout.write(json.dumps(event) + "\n")
    sys.stdout.flush()


def die_with_parent() -> None:
    """Ask the kernel to end this process when its parent dies, even by kill -9.

    Otherwise an orphan would go on rendering into the staging folder of a resumed run.
    Linux only; elsewhere the lock on the shard is what keeps two runs apart.
    """
    if sys.platform == "linux":
        parent = os.getppid()
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:  # died between the two calls
            os._exit(1)


def run_child(
    command: Sequence[str],
    *,
    log: Path,
    on_event: Callable[[Event], None],
    is_last: Callable[[Event], bool],
    env: dict[str, str] | None = None,
) -> Event:
    """Run `command`, hand every JSON line of its output to `on_event`, keep the rest in `log`.

    The result is the event that `is_last` recognises, with which the child says that its work is done.
    Raises ChildError when the child exits with a status other than 0, or without that event; its message is
    the end of the log, one line of it when the status is BAD_INPUT.
    """
    last: Event | None = None
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as log_file:
        start = log_file.tell()
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log_file, text=True, env={**os.environ, **(env or {})}
        )
        assert process.stdout is not None
        try:
            for line in process.stdout:
                event = _event(line)
                if event is None:
                    log_file.write(line.encode())
                    log_file.flush()
                    continue
                on_event(event)
                last = event if is_last(event) else last
            status = process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
    if status == BAD_INPUT:
        raise ChildError(_log_end(log, start, lines=1), status=status, log=log)
    if status != 0 or last is None:
        ended = f"by signal {signal.Signals(-status).name}" if status < 0 else f"with status {status}"
        ended += "" if status else " and did not say that it was done"
        end = _log_end(log, start, lines=LOG_LINES_SHOWN)
        raise ChildError(f"{end}\n(child ended {ended}; full log: {log})", status=status, log=log)
    return last


def _event(line: str) -> Event | None:
    """The event in a line of output; None for anything else that a library prints."""
    try:
        event = json.loads(line) if line.startswith("{") else None
    except ValueError:
        return None
    return event if isinstance(event, dict) else None


def _log_end(log: Path, start: int, *, lines: int) -> str:
    with log.open("rb") as file:
        file.seek(start)
        written = file.read().decode(errors="replace").strip().splitlines()
    return "\n".join(written[-lines:]) if written else "no output"
