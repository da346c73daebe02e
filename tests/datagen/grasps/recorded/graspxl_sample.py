"""Where GraspXL's real sample lies on this machine, if it does."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[4]
SHARED = ROOT.parent / "shared" / "graspxl_sample"
SAMPLE = Path(os.environ["GRASPXL"]) if os.environ.get("GRASPXL") else SHARED

needs_sample = pytest.mark.skipif(not SAMPLE.is_dir(), reason="needs ../shared/graspxl_sample or $GRASPXL")
