"""What motion costs: the same places with and without it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks.accuracy.motion_price import CASES, PartlyStillSet, main

SEED = 6210


def test_only_motion_differs_between_the_cases() -> None:
    """The same walls and bodies at the same places in all cases; what stands still has no speed."""
    scenes = {
        case: PartlyStillSet(seed=SEED, places=1, vehicle_moves=vehicle, others_move=others).place(0).scene
        for case, (vehicle, others) in CASES.items()
    }
    moving = scenes["all move"]
    assert moving.ego.speed_mps > 0.0
    assert max(item.speed_mps for item in moving.objects) > 0.0
    for case, (vehicle, others) in CASES.items():
        scene = scenes[case]
        assert scene.surfaces == moving.surfaces
        assert [(item.x_m, item.y_m) for item in scene.objects] == [(item.x_m, item.y_m) for item in moving.objects]
        assert (scene.ego.speed_mps > 0.0) == vehicle
        assert any(item.speed_mps > 0.0 for item in scene.objects) == others


def test_each_case_has_a_line_for_both_looks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One drive, all cases; the second run reads the files of the first."""
    command = ["motion_price", "--drives", "1", "--seed", str(SEED), "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", command)
    main()
    first = capsys.readouterr().out
    assert [text.split(" found ")[0].strip() for text in first.splitlines()] == [
        f"{case}, {look}" for case in CASES for look in ("default", "magnitudes")
    ]
    main()
    assert capsys.readouterr().out == first
