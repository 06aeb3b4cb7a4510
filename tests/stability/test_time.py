"""Hard cases of time: no time, backwards and very long, a million steps, clocks that jump or wrap, headings that do."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest

from models.perception.form.coarray import AzimuthInterpolator
from models.perception.form.ra_forming import ScanProfiles, form_map
from models.vehicle.can_decoder import StampMapper
from msgs.values.frames import Pose2
from msgs.values.radar import RadarSetup
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.vehicle import ego_motion
from nodes.inputs.view_latency import ViewWatch, last_beam_ns
from tests.stability.catalogue import Errors

EPOCH_NS = 1_763_750_000_123_456_789


def arc_m(speed_mps: float, yaw_rate_rps: float, elapsed_s: float) -> tuple[float, float]:
    """Where constant speed and yaw rate lead, to 50 digits."""
    with mpmath.workdps(50):
        v, w, t = (mpmath.mpf(value) for value in (speed_mps, yaw_rate_rps, elapsed_s))
        half = w * t / 2
        chord = v * t * (mpmath.sin(half) / half if half else 1)
        return float(chord * mpmath.cos(half)), float(chord * mpmath.sin(half))


def radius_m(speed_mps: float, yaw_rate_rps: float, elapsed_s: float) -> tuple[float, float]:
    """The same on a circle of radius v / w, as it is first written."""
    radius = speed_mps / yaw_rate_rps
    return radius * math.sin(yaw_rate_rps * elapsed_s), radius * (1.0 - math.cos(yaw_rate_rps * elapsed_s))


@pytest.mark.hard("msgs.values.vehicle.ego_motion", "circle of radius v / w", 4e-15, "m",
                  "rounding of 9 m, four products")  # fmt: skip
def test_all_but_straight(errors: Errors) -> None:
    """30 m/s for 0.3 s at 1e-12 to 1e-3 rad/s: 1 - cos(w t) keeps no digits, the radius has all too many."""
    naive = ours = 0.0
    for yaw_rate_rps in 10.0 ** np.arange(-12.0, -2.0):
        exact, pose = arc_m(30.0, yaw_rate_rps, 0.3), ego_motion(30.0, yaw_rate_rps, 0.3)
        ours = max(ours, math.dist(exact, (pose.x_m, pose.y_m)))
        naive = max(naive, math.dist(exact, radius_m(30.0, yaw_rate_rps, 0.3)))
    errors(naive=naive, ours=ours)


@pytest.mark.parametrize(("yaw_rate_rps", "elapsed_s"), [(0.0, 0.3), (0.0, 0.0)], ids=["straight", "no time"])
@pytest.mark.hard("msgs.values.vehicle.ego_motion", "circle of radius v / w", 0.0, "m", "closed form v t")
def test_no_turn(errors: Errors, yaw_rate_rps: float, elapsed_s: float) -> None:
    """Straight on, or no time at all: the circle has no radius."""
    pose = ego_motion(30.0, yaw_rate_rps, elapsed_s)
    try:
        naive = math.dist((30.0 * elapsed_s, 0.0), radius_m(30.0, yaw_rate_rps, elapsed_s))
    except ZeroDivisionError:
        naive = math.inf
    errors(naive=naive, ours=math.dist((30.0 * elapsed_s, 0.0), (pose.x_m, pose.y_m)))


@pytest.mark.parametrize("elapsed_s", [86_400.0, -86_400.0], ids=["forwards", "backwards"])
@pytest.mark.hard("msgs.values.vehicle.ego_motion", "steps of 0.1 s along the heading", 43_200.0 * 2.0**-52 * 60.0, "m",
                  "4e4 rad rounded at 2e-16, times the diameter of 60 m and a few")  # fmt: skip
def test_a_day_on_a_circle(errors: Errors, elapsed_s: float) -> None:
    """30 m/s at 1 rad/s for a day, either way: the clock jumped; still a point of a circle of 30 m."""
    exact, pose = arc_m(30.0, 1.0, elapsed_s), ego_motion(30.0, 1.0, elapsed_s)
    heading_rad = math.copysign(0.1, elapsed_s) * np.arange(864_000)
    step_m = 0.1 * 30.0 * math.copysign(1.0, elapsed_s)
    naive = step_m * np.cos(heading_rad).sum(), step_m * np.sin(heading_rad).sum()
    errors(naive=math.dist(exact, naive), ours=math.dist(exact, (pose.x_m, pose.y_m)))


@pytest.mark.slow
@pytest.mark.hard("msgs.values.frames.Pose2", "running sums in float32", 1e5 * (2.0 + 1.0 + 1.0) * 2.0**-52 * 200.0,
                  "m",
                  "heading rounded thrice a step, at half an ulp of 2 pi, pi and pi; times the diameter of 200 "
                  "m")  # fmt: skip
def test_a_hundred_thousand_steps(errors: Errors) -> None:
    """10 m/s and 0.1 rad/s in steps of 10 ms for 1e3 s: float32 heading at 100 rad moves by steps of 8e-6."""
    step = ego_motion(10.0, 0.1, 0.01)
    pose = Pose2()
    for _ in range(100_000):
        pose = pose @ step
    exact = arc_m(10.0, 0.1, 1e3)
    heading_rad = np.cumsum(np.full(100_000, 0.001, np.float32))
    naive = [float(np.cumsum(np.float32(0.1) * turn(heading_rad))[-1]) for turn in (np.cos, np.sin)]
    errors(naive=math.dist(exact, naive), ours=math.dist(exact, (pose.x_m, pose.y_m)))


@pytest.mark.hard("msgs.values.frames.Pose2", "difference of two headings", 1e-15, "rad", "rounding of pi")
def test_turn_across_the_heading_wrap(errors: Errors) -> None:
    """From a heading of 179 to one of -179 degrees: 2 degrees to the left, not 358 to the right."""
    before, after = Pose2(0.0, 0.0, math.radians(179.0)), Pose2(0.0, 0.0, math.radians(-179.0))
    exact = math.radians(2.0)
    turned = (before.inverse() @ after).yaw_rad
    errors(naive=abs(after.yaw_rad - before.yaw_rad - exact), ours=abs(turned - exact))


@pytest.mark.hard("models.perception.form.ra_forming", "interpolation between float64 epochs", 0.5, "ns",
                  "rounding to whole nanoseconds")  # fmt: skip
def test_stamps_of_the_azimuths(errors: Errors) -> None:
    """Epochs of 1.8e18 ns are 256 ns apart in float64: relative to the scan all digits are there."""
    setup = RadarSetup()
    interpolator = AzimuthInterpolator(setup)
    beams = len(setup.beams)
    stamps_ns = EPOCH_NS + 1 + setup.beam_interval_ns * np.arange(beams, dtype=np.int64)
    scan = ScanProfiles(
        stamp_ns=int(stamps_ns[0]), scan_id=0, profiles=np.zeros((beams, 512), np.complex64), noise_power_mw=1e-13,
        beam_stamp_ns=stamps_ns,
    )  # fmt: skip
    beam_rad, column_rad = setup.beams.azimuth_rad, interpolator.grid.azimuth_rad
    with mpmath.workdps(40):
        exact_ns = [interpolated(float(at), beam_rad, stamps_ns) for at in column_rad]
    ours_ns = form_map(scan, interpolator).azimuth_stamp_ns
    naive_ns = np.interp(column_rad, beam_rad, stamps_ns.astype(np.float64)).astype(np.int64)
    errors(
        naive=max(abs(float(int(one) - exact)) for one, exact in zip(naive_ns, exact_ns, strict=True)),
        ours=max(abs(float(int(one) - exact)) for one, exact in zip(ours_ns, exact_ns, strict=True)),
    )


def interpolated(at: float, x: np.ndarray, y: np.ndarray) -> mpmath.mpf:
    """Linear interpolation of integers in 40 digits."""
    i = int(np.clip(np.searchsorted(x, at) - 1, 0, len(x) - 2))
    share = (mpmath.mpf(at) - mpmath.mpf(float(x[i]))) / (mpmath.mpf(float(x[i + 1])) - mpmath.mpf(float(x[i])))
    return int(y[i]) + min(max(share, mpmath.mpf(0)), mpmath.mpf(1)) * int(y[i + 1] - y[i])


@pytest.mark.parametrize("jump_s", [3600.0, -3600.0], ids=["forwards", "backwards"])
@pytest.mark.hard("nodes.inputs.view_latency", "deadline against now less stamp", 0.0, "views",
                  "every view came 0.1 s after its last beam")  # fmt: skip
def test_views_of_a_clock_that_jumps(errors: Errors, jump_s: float) -> None:
    """The radar's clock is an hour off from the tenth view on: late by an hour, or there before it was measured."""
    watch = ViewWatch(EPOCH_NS)
    period_ns = ns_from_s(RadarSetup().radar.scan_period_s)
    delay_ns = last_beam_ns() + 100_000_000
    naive = 0
    for scan_id in range(20):
        now_ns = EPOCH_NS + scan_id * period_ns + delay_ns
        stamp_ns = now_ns - delay_ns - (ns_from_s(jump_s) if scan_id >= 10 else 0)
        watch.add(scan_id, stamp_ns, now_ns)
        naive += not 0.0 <= s_from_ns(now_ns - stamp_ns - last_beam_ns()) <= 0.3
    figures = watch.figures(EPOCH_NS + 20 * period_ns + delay_ns)
    errors(naive=naive, ours=figures.misses_total)


@pytest.mark.hard("nodes.inputs.view_latency", "difference of scan numbers", 0.0, "views",
                  "no period passed between the two without a view")  # fmt: skip
def test_scan_numbers_that_jump(errors: Errors) -> None:
    """A source that starts anew counts from 2^31 on: one period passed, not 2^31 scans without a view."""
    watch, period_ns = ViewWatch(0), ns_from_s(RadarSetup().radar.scan_period_s)
    watch.add(7, 0, last_beam_ns())
    watch.add(2**31, period_ns, period_ns + last_beam_ns())
    errors(naive=2**31 - 7 - 1, ours=watch.figures(period_ns + last_beam_ns()).absent_total)


@pytest.mark.hard("models.vehicle.can_decoder", "one offset between the clocks", 200e-6, "s",
                  "the delay of every frame, 0.2 ms")  # fmt: skip
def test_source_clock_that_wraps(errors: Errors) -> None:
    """A counter of 32 bits of microseconds wraps after 71 minutes: two windows of 1 s later stamps are right again."""
    mapper, wrap_ns, delay_ns = StampMapper(), 2**32 * 1000, 200_000
    naive = ours = 0.0
    for now_ns in range(wrap_ns - 3_000_000_000, wrap_ns + 4_000_000_000, 10_000_000):
        stamp_ns = now_ns % wrap_ns
        mapped_ns = mapper.map(stamp_ns, now_ns + delay_ns)
        if now_ns >= wrap_ns + 2_000_000_000 + 20_000_000:
            naive = max(naive, abs(s_from_ns(stamp_ns + delay_ns - now_ns)))
            ours = max(ours, abs(s_from_ns(mapped_ns - now_ns)))
    errors(naive=naive, ours=ours)
