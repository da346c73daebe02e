"""The machine a run trains on, and the precision it multiplies in: what the device is fast at, unless one is demanded.

Many processors take bfloat16 and emulate it: on one with AVX2, a 3D convolution ran at 0.16 GFLOP/s in bfloat16 and
at 55 in float32. Names of instruction sets do not tell, so both are tried.
"""

import math
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

__all__ = [
    "Machine",
    "Precision",
    "UsedPrecision",
    "bfloat16_speedup",
    "changes",
    "this_machine",
    "used_precision",
]

UsedPrecision = Literal["bfloat16", "float32"]
Precision = Literal["auto", "bfloat16", "float32"]

_REPEATS = 3
_HOPELESS = 0.5  # of the speed of float32: one try is enough
_WORTH_A_WARNING = 1.5


@dataclass(frozen=True, kw_only=True)
class Machine:
    """What decides the last bits of a run besides its configuration and its data."""

    device: str  # "cpu", "cuda", "mps"
    processor: str  # of the device, as it names itself
    kernels: str  # instruction set of PyTorch's CPU kernels
    threads: int  # sums are split among them
    precision: UsedPrecision


def this_machine(device: torch.device, precision: UsedPrecision) -> Machine:
    """The machine that this process runs on."""
    return Machine(
        device=device.type,
        processor=_processor(device),
        kernels=torch.backends.cpu.get_cpu_capability(),
        threads=torch.get_num_threads(),
        precision=precision,
    )


def used_precision(
    demanded: Precision,
    device: torch.device,
    recorded: Machine | None = None,
    speedup: Callable[[torch.device], float] | None = None,
) -> tuple[UsedPrecision, str]:
    """The precision of a run, and one line that says it and why.

    `recorded`: the machine of the checkpoint that the run resumes from. On the same kind of machine `auto` keeps its
    precision, so that a probe on a busy day cannot change the result. `speedup`: how fast bfloat16 is, measured if
    not given.
    """
    if demanded == "auto" and recorded is not None and this_machine(device, recorded.precision) == recorded:
        return recorded.precision, f"precision: {recorded.precision}, as before on this kind of machine"
    ratio = (speedup or bfloat16_speedup)(device)
    used: UsedPrecision = ("bfloat16" if ratio > 1 else "float32") if demanded == "auto" else demanded
    line = f"precision: {used} ({_compared(ratio)} on {_processor(device)})"
    slower = 1 / ratio if used == "bfloat16" else ratio
    if demanded != "auto" and slower > _WORTH_A_WARNING:
        line = f"warning: {line}: slow here, and demanded by the configuration; precision: auto takes the faster one"
    return used, line


def changes(before: Machine, now: Machine) -> str | None:
    """One line on what is new when a run resumes elsewhere; None on the same kind of machine."""
    old, new = asdict(before), asdict(now)
    differing = [f"{name} {old[name]} -> {new[name]}" for name in old if old[name] != new[name]]
    if not differing:
        return None
    return f"resumed on another kind of machine: {', '.join(differing)}; from here on not bit-exact"


def bfloat16_speedup(device: torch.device) -> float:
    """Speed of bfloat16 over that of float32 in a 3D convolution and a matrix product, forward and backward.

    0 where the device has no bfloat16. Below a second, a few where it is emulated. On a CPU one thread's processor
    time is measured, so that other programs do not count.
    """
    threads = torch.get_num_threads()
    if device.type == "cpu":
        torch.set_num_threads(1)
    try:
        return _speedup(device, side=12 if device.type == "cpu" else 32)
    finally:
        torch.set_num_threads(threads)


def _speedup(device: torch.device, side: int) -> float:
    volume = torch.ones(1, 32, side, side, side, device=device, requires_grad=True)
    kernel = torch.ones(32, 32, 3, 3, 3, device=device, requires_grad=True)
    rows = torch.ones(40 * side, 20 * side, device=device, requires_grad=True)
    matrix = torch.ones(20 * side, 20 * side, device=device, requires_grad=True)

    def multiply() -> Tensor:
        return functional.conv3d(volume, kernel, padding=1).sum() + functional.linear(rows, matrix).sum()

    best = {torch.float32: math.inf, torch.bfloat16: math.inf}
    for repeat in range(1 + _REPEATS):  # the first makes the kernels
        for dtype in best:
            try:
                seconds = _seconds(multiply, device, dtype)
            except RuntimeError:  # the backend says that it has no such type
                return 0.0
            if repeat > 0:
                best[dtype] = min(best[dtype], seconds)
        if repeat > 0 and best[torch.float32] < _HOPELESS * best[torch.bfloat16]:
            break
    return best[torch.float32] / best[torch.bfloat16]


def _seconds(multiply: Callable[[], Tensor], device: torch.device, dtype: torch.dtype) -> float:
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    start = clock()
    with torch.autocast(device.type, torch.bfloat16, enabled=dtype == torch.bfloat16):
        total = multiply()
    total.backward()
    total.item()  # waits for the device
    return clock() - start


def _compared(ratio: float) -> str:
    if ratio == 0:
        return "no bfloat16"
    return f"bfloat16 is {ratio:.1f}x as fast" if ratio >= 1 else f"bfloat16 is {1 / ratio:.1f}x slower"


def _processor(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    cpuinfo = Path("/proc/cpuinfo")
    if device.type == "cpu" and cpuinfo.is_file():
        for line in cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
