"""Which stretches of a log the side street can be laid past, and how `benchmarks.accuracy.side_street --log`
refuses."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

from benchmarks.accuracy import side_street
from benchmarks.accuracy.side_street_drives import UnsuitableError, _require_sight, logged, moved, street
from msgs.values.frames import Pose2
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState
from sim_player.drive import DrivePlayer

DBC, MAPPING = "launch/can/mirrorwave.dbc", "launch/can/mirrorwave.yaml"
DURATION_S = 8.0


def told(speed_mps: float, yaw_rate_dps: float, rest_s: float = 0.0) -> list[VehicleState]:
    """50 states a second: a rest, then steady driving."""
    times_s = np.arange(0.0, rest_s + DURATION_S, 0.02)
    return [
        VehicleState(
            stamp_ns=10**18 + ns_from_s(float(time_s)),
            speed_mps=speed_mps if time_s >= rest_s else 0.0,
            yaw_rate_rps=math.radians(yaw_rate_dps) if time_s >= rest_s else 0.0,
        )
        for time_s in times_s
    ]


def test_the_scripted_motion_gets_the_scripted_street() -> None:
    """4 m/s and 3 deg/s as told on the bus: walls and cars come to lie where the drive's file has them.

    Tolerance: the smoothing at both ends of the log and the integral's steps, 1 cm.
    """
    course = logged(told(4.0, 3.0, rest_s=1.0), "log", from_s=1.6)
    for ours, theirs in zip(course.scene.surfaces, street().surfaces, strict=True):
        np.testing.assert_allclose(ours.polyline_m, theirs.polyline_m, atol=1e-2)
    for ours, theirs in zip(course.scene.objects, street().objects, strict=True):
        assert (ours.x_m, ours.y_m, ours.yaw_deg) == pytest.approx((theirs.x_m, theirs.y_m, theirs.yaw_deg), abs=1e-2)
    assert course.stretch is not None
    assert course.stretch.rest_s == pytest.approx(0.98)


def test_the_first_stretch_that_suits_is_taken() -> None:
    """From the second in which it starts: smoothed, the start's step is over 2 m/s there."""
    course = logged(told(5.0, -2.0, rest_s=1.0), "log")
    assert course.stretch is not None
    assert course.stretch.from_s == 1.0
    assert "no rest" not in side_street.about(course.stretch)
    assert "no rest" in side_street.about(msgspec.structs.replace(course.stretch, rest_s=0.0))


def without(states: list[VehicleState], low_s: float, high_s: float) -> list[VehicleState]:
    first_ns = states[0].stamp_ns
    return [one for one in states if not low_s <= 1e-9 * (one.stamp_ns - first_ns) <= high_s]


@pytest.mark.parametrize(
    ("states", "from_s", "why"),
    [
        (told(4.0, 0.1), 1.0, "turns by 0.6 deg, must be 5 at least"),
        (told(20.0, 3.0), 1.0, r"speed 20.0..20.0 m/s, must stay within 2..8"),
        (told(0.0, 0.0), 1.0, "speed 0.0..0.0 m/s"),
        (without(told(4.0, 3.0), 3.0, 3.5), 1.0, "without a valid state, must be 0.1 s at most"),
        (told(4.0, 3.0), 3.0, "without a valid state"),
        (told(4.0, -14.0), 1.0, "passes a wall of the street at"),
        (told(4.0, 3.0), math.nan, "must lie within the log, 0..8.0 s"),
        (told(4.0, 3.0), 1e9, "must lie within the log"),
        (told(4.0, 3.0)[:1], 0.0, "without a valid state"),
        (told(4.0, 0.1), None, "no stretch of 6 s suits the street"),
    ],
)
def test_what_does_not_suit_is_refused(states: list[VehicleState], from_s: float | None, why: str) -> None:
    with pytest.raises(UnsuitableError, match=why):
        logged(states, "log", from_s)


def test_a_car_that_nothing_hides_is_refused() -> None:
    course = logged(told(4.0, 3.0), "log", from_s=1.0)
    walls = tuple(one for one in course.scene.surfaces if one.role == "relay")
    open_street = msgspec.structs.replace(course.scene, surfaces=walls)
    player = DrivePlayer(open_street, course.motion, Pose2(), chirps_per_beam=1)
    with pytest.raises(UnsuitableError, match="hidden for 0 scans, must be 8 at least"):
        _require_sight(player, "log: from 1 s")


def test_a_moved_scene_keeps_its_distances() -> None:
    scene, there = street(), moved(street(), Pose2(3.0, -2.0, 1.2))
    corner, car = (
        (np.array(one.surfaces[2].polyline_m[1]) for one in (scene, there)),
        (scene.objects[0], there.objects[0]),
    )
    away_m = [math.dist(point, (one.x_m, one.y_m)) for point, one in zip(corner, car, strict=True)]
    assert away_m[0] == pytest.approx(away_m[1])
    assert not there.ego.speed_mps


def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Standard error of a run that ends with 2."""
    monkeypatch.setattr(sys, "argv", ["side_street", *arguments])
    try:
        code: object = side_street.main()
    except SystemExit as stop:
        code = stop.code
    assert code == 2
    return capsys.readouterr().err


def test_bad_files_are_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    empty, damaged = tmp_path / "empty.log", tmp_path / "damaged.log"
    empty.write_bytes(b"")
    damaged.write_bytes(b"(1.0) can0 0D0#\xff\xfe(\n" * 3)
    for log, dbc, mapping in (
        ("missing.log", DBC, MAPPING),
        (str(empty), DBC, MAPPING),
        (str(damaged), DBC, MAPPING),
        (str(empty), "missing.dbc", MAPPING),
        (str(empty), DBC, "launch/can/motec_sample.yaml"),
    ):
        said = refused(monkeypatch, capsys, "--log", log, "--dbc", dbc, "--mapping", mapping)
        assert said.count("\n") == 1
        assert any(name in said for name in (log, dbc, mapping))


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("--log", "a.log"), "--log, --dbc and --mapping go together"),
        (("--from", "3"), "--from needs --log"),
        (("--seeds", "0"), "--seeds and --chirps must be 1 at least"),
    ],
)
def test_options_go_together(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], why: str
) -> None:
    assert why in refused(monkeypatch, capsys, *arguments)
