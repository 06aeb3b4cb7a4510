"""What `benchmarks.accuracy.side_street` prints and draws, from reports by hand."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure

from benchmarks.accuracy import side_street
from benchmarks.accuracy.side_street import (
    SCAN_BY_SCAN,
    STANDING,
    STATELESS,
    TRACKED,
    Said,
    Scan,
    describe,
    difference,
    line,
    row,
    said,
    visible_means,
    ways,
)
from models.perception.tracking.odometry import OdometryPose, stationary_pose
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, BevGrid, HiddenObject, SceneTruth, TruthObject

NONE = np.zeros((0, 3), np.float32)


def truth(hidden: bool) -> SceneTruth:
    """A car of 4 m by 2 m along x at (20, 10), its side y = 9 seen in a mirror or directly; a parked one far off."""
    side = np.array([[19.0, 9.0, 0.0], [21.0, 9.0, 0.0]], np.float32)
    cars = tuple(
        TruthObject(id=n, object_class="car", x_m=x, y_m=10.0, length_m=4.0, width_m=2.0, yaw_rad=0.0, hidden=hide)
        for n, (x, hide) in enumerate(((20.0, hidden), (60.0, True)))
    )
    return SceneTruth(
        stamp_ns=0, scan_id=0, los_points_m=NONE if hidden else side, mirrored_points_m=side, hidden_points_m=side,
        hidden_object=np.zeros(2, np.int32), objects=cars,
    )  # fmt: skip


def scan(time_s: float, hidden: bool = True) -> Scan:
    frame = BevFrame(
        stamp_ns=0, scan_id=0, los_points_m=np.zeros((0, 2), np.float32), grid=BevGrid(rows=1, columns=1),
        visibility=np.zeros((1, 1), np.uint8),
    )  # fmt: skip
    return Scan(time_s=time_s, frame=frame, stateless=frame, truth=truth(hidden), place=stationary_pose())


def test_both_errors_are_said() -> None:
    """0.4 m before the visible side: 1.4 m off the centre."""
    found = HiddenObject(
        id=5, x_m=20.0, y_m=8.6, length_m=3.0, width_m=1.0, yaw_rad=0.0, score=0.9, cov_m2=((1.0, 0.0), (0.0, 1.0))
    )
    now = said(scan(0.3), [found], side_street.CAR)
    assert now.id == 5
    assert (now.face_error_m, now.centre_error_m) == (pytest.approx(0.4), pytest.approx(1.4))
    assert said(scan(0.3), [], side_street.CAR).id is None


def reported(ids: list[int | None], face_m: float = 0.3, centre_m: float = 1.0) -> list[Said]:
    """Reports 0.3 s apart."""
    errors = {"face_error_m": face_m, "centre_error_m": centre_m}
    return [
        Said(time_s=0.3 * n) if one is None else Said(time_s=0.3 * n, id=one, **errors) for n, one in enumerate(ids)
    ]


TOLD = {
    SCAN_BY_SCAN: [reported([1, 2, None, 3]), reported([None] * 4)],
    STANDING: [reported([None, None, 7, 7]), reported([None] * 4)],
    STATELESS: [reported([None, 9, 8, 8], face_m=0.5), reported([None] * 4)],
    TRACKED: [reported([None, 7, 7, 7], face_m=0.6), reported([4, 4, 4, 4], face_m=0.2, centre_m=0.8)],
}


def test_a_row_holds_both_errors() -> None:
    """3 errors of 0.6 m and 4 of 0.2 m, of 1 and 0.8 m: roots of (3 0.36 + 4 0.04) / 7 and of (3 + 4 0.64) / 7."""
    found = row(TRACKED, [TOLD], [1.2])
    assert found.face_rmse_m == pytest.approx(math.sqrt(1.24 / 7.0))
    assert found.centre_rmse_m == pytest.approx(math.sqrt(5.56 / 7.0))
    assert "RMSE face 0.42 m, centre 0.89 m" in line(found)


def test_the_figure_says_lead_and_ids_as_the_table_does() -> None:
    """Direct sight at 1.2 s: leads of 0.3, 0.6 and 0.9 s, and two changes of id without a tracker."""
    axes = Figure().subplots()
    scans = [*(scan(0.3 * n) for n in range(4)), scan(1.2, hidden=False)]
    side_street._draw_reports(axes, scans, TOLD)
    texts = [text.get_text() for text in axes.texts]
    assert texts[:4] == [
        f"{SCAN_BY_SCAN}: lead 0.3 s, 2 id switches",
        f"{STANDING}: lead 0.6 s, 0 id switches",
        f"{STATELESS}: lead 0.6 s, 1 id switches",
        f"{TRACKED}: lead 0.9 s, 0 id switches",
    ]
    assert "direct sight" in texts
    # a line where an id stays, and none across a change or a gap
    drawn = [len(one.get_xdata()) for one in axes.lines]
    assert (
        sum(count == 2 for count in drawn) == 2 + 1 + 1 + 1
    )  # steps of the tracked, stateless and standing, and dots of the last


def test_the_figure_shows_face_and_centre_errors() -> None:
    error, velocity = Figure().subplots(1, 2)
    side_street._draw_errors(error, velocity, TOLD)
    shown = {one.get_label(): np.nanmax(one.get_ydata()) for one in error.lines}
    assert shown[f"face, {TRACKED}"] == pytest.approx(0.6)
    assert shown[f"centre, {TRACKED}"] == pytest.approx(1.0)
    assert len(shown) == 8


def driven(time_s: float, later_s: float, speed_mps: float = 4.0) -> Scan:
    """A scan of a vehicle that drives towards the parked car, whose centre it measures `later_s` after its stamp."""
    one = scan(time_s)
    stamp_ns, x_m = 1_000_000_000 + round(1e9 * time_s), 60.0 - speed_mps * time_s
    cars = tuple(msgspec.structs.replace(car, x_m=x_m if car.id else -500.0) for car in one.truth.objects)
    here = HiddenObject(
        id=0, x_m=x_m, y_m=10.0, length_m=4.0, width_m=2.0, yaw_rad=0.0, score=0.9, cov_m2=((0.01, 0.0), (0.0, 0.01)),
        stamp_ns=stamp_ns + round(1e9 * later_s),
    )  # fmt: skip
    seen = msgspec.structs.replace(here, x_m=x_m - speed_mps * later_s)
    frame = msgspec.structs.replace(one.frame, stamp_ns=stamp_ns, objects=(here,))
    return Scan(
        time_s=time_s,
        frame=frame,
        stateless=msgspec.structs.replace(frame, objects=(seen,)),
        truth=msgspec.structs.replace(one.truth, stamp_ns=stamp_ns, objects=cars),
        place=OdometryPose(0, Pose2(speed_mps * time_s), speed_mps, 0.0),
    )


def test_a_tracker_that_is_not_told_of_the_motion_shifts_what_the_states_have_carried_to_the_scan() -> None:
    """At 4 m/s, measured 0.2 s after the stamp: 0.8 m ahead, where a radar without any state has no error."""
    told = ways([driven(0.3 * n, 0.2) for n in range(12)])
    last = {way: told[way][side_street.PARKED][-1] for way in (STANDING, STATELESS, TRACKED)}
    for way, error_m in ((STANDING, 0.8), (STATELESS, 0.0), (TRACKED, 0.0)):
        assert last[way].centre_error_m == pytest.approx(error_m, abs=0.02)


def test_the_difference_is_that_of_root_mean_squares_on_the_same_draws() -> None:
    """One seed has no spread. With odometry (3 0.36 + 4 0.04) / 7, without 0.25."""
    found = difference([TOLD])
    assert found.face_m == pytest.approx(math.sqrt(1.24 / 7.0) - 0.5)
    assert found.face_interval_m == pytest.approx((found.face_m, found.face_m))
    assert describe(found).startswith("with odometry less without vehicle states: face -0.08 m [-0.08, -0.08]")
    nothing = {way: [reported([None] * 4)] * 2 for way in TOLD}
    assert math.isnan(difference([nothing]).face_m)


def test_the_mean_of_visible_points_is_judged_as_a_report() -> None:
    """Both lie on the side at y = 9, their mean too: on a face, 1 m from the centre; the parked car has none."""
    assert visible_means([scan(0.0), scan(0.3)]) == [(pytest.approx(0.0), pytest.approx(1.0))]
