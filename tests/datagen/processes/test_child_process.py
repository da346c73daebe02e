"""Children report by JSON lines, their failures surface, and they die with their parent."""

import signal
import subprocess
import sys
import time
from typing import Any

import pytest

from datagen.processes.child_process import ChildError, Event, run_child

EMIT = "from datagen.processes.child_process import die_with_parent, emit\n"


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def is_done(event: Event) -> bool:
    return event["phase"] == "done"


def test_events_arrive_and_other_output_goes_to_the_log(tmp_path):
    events: list[dict[str, Any]] = []
    code = (
        EMIT
        + "print('chatter'); print('{not an event'); emit(phase='render', done=1); emit(phase='done', n=3)"
    )
    last = run_child(python(code), log=tmp_path / "child.log", on_event=events.append, is_last=is_done)
    assert events == [{"phase": "render", "done": 1}, {"phase": "done", "n": 3}]
    assert last == events[-1]
    assert (tmp_path / "child.log").read_text() == "chatter\n{not an event\n"


def test_success_without_the_last_event_is_a_failure_that_names_the_log(tmp_path):
    """As when Blender quits by itself in the middle of a render: the exit status says nothing."""
    code = EMIT + "import sys; emit(phase='render', done=1); print('Blender quit', file=sys.stderr)"
    log = tmp_path / "blender.log"
    with pytest.raises(ChildError) as caught:
        run_child(python(code), log=log, on_event=lambda _: None, is_last=is_done)
    assert str(caught.value) == (
        f"Blender quit\n(child ended with status 0 and did not say that it was done; full log: {log})"
    )
    assert (caught.value.status, caught.value.log) == (0, log)


def test_failure_carries_status_and_end_of_log(tmp_path):
    code = (
        "import sys; [print(i, file=sys.stderr) for i in range(100)]; sys.exit('texture missing: wood.png')"
    )
    with pytest.raises(ChildError, match=r"texture missing: wood\.png") as caught:
        run_child(python(code), log=tmp_path / "child.log", on_event=print, is_last=is_done)
    assert caught.value.status == 1
    assert "\n5\n" not in str(caught.value)  # the log is in its file, the message has its end


def test_death_by_signal_is_named(tmp_path):
    code = "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)"
    with pytest.raises(ChildError, match="SIGSEGV"):
        run_child(python(code), log=tmp_path / "child.log", on_event=print, is_last=is_done)


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel call exists on Linux")
def test_child_dies_when_its_parent_is_killed():
    grandchild = EMIT + "die_with_parent(); print('ready', flush=True); import time; time.sleep(600)"
    code = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen([sys.executable, '-c', {grandchild!r}])\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(600)\n"
    )
    parent = subprocess.Popen(python(code), stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    assert parent.stdout.readline() == "ready\n"
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline and _is_running(pid):
        time.sleep(0.05)
    assert not _is_running(pid)


def _is_running(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
