"""Two scenes under mild and severe faults of the hardware: mild ones cost nothing, severe ones are never silent.

The short form of `benchmarks.accuracy.severity` (docs/results/README.md).
"""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.accuracy.severity import FAULTS, run
from benchmarks.accuracy.six_scenes import SCENES

TWO = [scene for scene in SCENES if scene.stem in ("oblique_container", "two_hidden_vehicles")]
#: Mild, severe, and the flag that a severe fault must raise.
CASES = {
    "phase_errors": (10.0, 60.0, "array_error"),
    "mute_beams": (2.0, 12.0, "silent_beams"),
    "missing_chirps": (25.0, 97.0, "lost_chirps"),
}


def test_the_cases_are_the_benchmarks() -> None:
    assert all({mild, severe} <= set(FAULTS[fault].severities) for fault, (mild, severe, _) in CASES.items())
    assert len(TWO) == 2


@pytest.mark.slow
@pytest.mark.parametrize("fault", CASES)
@pytest.mark.parametrize("scene", TWO, ids=lambda scene: scene.stem)
def test_mild_faults_keep_every_vehicle_and_severe_ones_are_flagged(scene: Path, fault: str) -> None:
    """Found means within 1 m."""
    mild, severe, flag = CASES[fault]
    case = run(fault, mild, scene, seed=0)
    assert (case.missed, case.ghosts) == (0, 0)
    assert len(case.errors_m) == case.asked > 0
    assert flag in run(fault, severe, scene, seed=0).flags
