"""The promise of the package on its own objects. Slow: about two minutes of one core."""

from dataclasses import replace

import numpy as np
import pytest

from datagen.grasps.synthesis.report import summarise
from datagen.grasps.synthesis.synthesise import synthesise_grasp


@pytest.mark.slow
def test_nine_in_ten_starter_objects_are_held_within_twenty_attempts(hand, config):
    from datagen.objects.stores.library import StarterPack  # heavy: only when this test runs

    pack = StarterPack()
    report = summarise(
        synthesise_grasp(hand, pack.load(uid), replace(config, proposals=16), np.random.default_rng([0, k]))
        for k, uid in enumerate(pack.uids())
    )
    for row in (*report.rows, report.total):
        print(
            f"{row.object_uid:40s} kept {row.kept}/{row.motions} attempts {row.attempts:3d} "
            f"penetration {row.penetration_mm:4.1f} mm digits {row.digits:.0f} "
            f"slip {row.slip_lift_mm:4.1f}/{row.slip_manipulation_mm:4.1f} mm "
            f"turn {row.rotation_range_deg:4.0f} deg {row.cpu_seconds_per_kept:5.1f} s {row.failures}"
        )
    assert len(report.rows) >= 40
    assert report.objects_kept_share >= 0.9
    assert report.total.penetration_mm <= 2.0
    assert report.total.digits >= 3
    assert report.total.slip_lift_mm <= 10.0
    assert report.total.slip_manipulation_mm <= 10.0
    assert report.total.cpu_seconds_per_kept <= 5.0
