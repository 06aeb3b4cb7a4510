"""Levels of a plan, with their reasons."""

from __future__ import annotations

import msgspec

from sim_player.planner.levels import levels_of
from tests.sim_player.planner.plans import plan_effects
from tests.sim_player.planner.test_plan import CAR, WALL, scene


def test_kernel_at_rest_and_beats_in_motion() -> None:
    still, moving = scene(WALL, CAR), scene(WALL, msgspec.structs.replace(CAR, speed_mps=5.0))
    assert levels_of(plan_effects(still))[0].choice == "kernel"
    signal = levels_of(plan_effects(moving))[0]
    assert signal.choice == "beat"
    assert "at rest" in signal.reason


def test_rough_walls_by_kirchhoff() -> None:
    smooth, rough = msgspec.structs.replace(WALL, roughness_mm=0.0), msgspec.structs.replace(WALL, roughness_mm=1.5)
    assert levels_of(plan_effects(scene(smooth, CAR)))[1].choice == "none"
    found = levels_of(plan_effects(scene(rough, CAR)))[1]
    assert found.choice == "kirchhoff"
    # 4 pi 1.5 mm / 30 mm
    assert "1.5 mm" in found.reason
    assert "0.6 rad" in found.reason
