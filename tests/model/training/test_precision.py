"""Precision follows the processor: chosen by a probe, said, recorded, and kept where a run is resumed."""

import os
import platform
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.nn import functional

from model.training.precision import (
    bfloat16_speedup,
    changes,
    this_machine,
    used_precision,
)

ROOT = Path(__file__).resolve().parents[3]
CPU = torch.device("cpu")


def never(_: torch.device) -> float:
    raise AssertionError("the device is not to be tried")


@pytest.mark.parametrize(("ratio", "expected"), [(3.4, "bfloat16"), (0.2, "float32"), (0.0, "float32")])
def test_auto_takes_the_faster_one_and_says_why(ratio: float, expected: str) -> None:
    used, line = used_precision("auto", CPU, speedup=lambda _: ratio)
    assert used == expected
    assert line.startswith(f"precision: {expected}")
    assert {3.4: "3.4x as fast", 0.2: "5.0x slower", 0.0: "no bfloat16"}[ratio] in line


@pytest.mark.parametrize(
    ("demanded", "ratio", "warns"),
    [("bfloat16", 0.2, True), ("bfloat16", 0.9, False), ("float32", 3.0, True), ("float32", 0.5, False)],
)
def test_what_is_demanded_is_used_with_a_warning_where_it_is_slow(demanded, ratio, warns) -> None:
    used, line = used_precision(demanded, CPU, speedup=lambda _: ratio)
    assert used == demanded
    assert line.startswith("warning: ") == warns
    assert f"precision: {demanded}" in line


@pytest.mark.parametrize("precision", ["bfloat16", "float32"])
def test_a_run_resumed_on_the_same_machine_keeps_its_precision_without_trying(precision) -> None:
    used, _ = used_precision("auto", CPU, this_machine(CPU, precision), speedup=never)
    assert used == precision


def test_a_run_resumed_elsewhere_follows_the_new_processor_and_says_what_changed() -> None:
    before = replace(this_machine(CPU, "bfloat16"), processor="Another Processor")
    used, _ = used_precision("auto", CPU, before, speedup=lambda _: 0.1)
    assert used == "float32"
    line = changes(before, this_machine(CPU, used))
    assert line is not None
    assert "processor Another Processor -> " in line
    assert "precision bfloat16 -> float32" in line
    assert changes(before, before) is None


def test_the_probe_prefers_what_is_faster_in_a_larger_convolution() -> None:
    """Sizes of the VAE's levels in `small`, five times those of the probe."""
    seconds = {}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    volume, kernel = torch.randn(1, 64, 12, 12, 12), torch.randn(64, 64, 3, 3, 3, requires_grad=True)
    for dtype in (torch.float32, torch.bfloat16):
        spent = []
        for _ in range(3):
            start = time.process_time()
            with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
                functional.conv3d(volume, kernel, padding=1).sum().backward()
            spent.append(time.process_time() - start)
        seconds[dtype] = min(spent)
    torch.set_num_threads(threads)
    used, _ = used_precision("auto", CPU)
    chosen, other = sorted(seconds, key=lambda dtype: (dtype == torch.bfloat16) != (used == "bfloat16"))
    assert seconds[chosen] < 1.5 * seconds[other]


def test_the_probe_leaves_the_threads_as_they_were() -> None:
    threads = torch.get_num_threads()
    bfloat16_speedup(CPU)
    assert torch.get_num_threads() == threads


@pytest.mark.skipif(platform.machine() != "x86_64", reason="restricts the kernels of x86 processors")
def test_a_processor_without_bfloat16_gets_float32() -> None:
    """The kernels of a laptop's processor (AVX2), whatever this one is."""
    code = (
        "import torch; from model.training.precision import used_precision; "
        "print(used_precision('auto', torch.device('cpu'))[1])"
    )
    laptop = {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | laptop, capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("precision: float32 (bfloat16 is ")
