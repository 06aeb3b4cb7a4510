"""From a recorded drive to where the radar sits and how its clock runs: maps, walls, solution, and once more.

The walls' sightings come from maps whose beams are freed from the vehicle's motion, for which mounting and clock must
be known. So beams are formed twice: as the prior has it, then as the first solution has it. A recording without raw
beams gives the peaks that the graph found, once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from contrib.calibrate.capture import Capture
from contrib.calibrate.mounting import Motion, Mounting, Sighting, solve_mounting
from models.perception.find.detectors import CfarDetector
from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import FormingParams
from models.perception.mirrors.peaks_to_view import GeometryParams, direct_structure
from models.perception.mirrors.recovery import cartesian_covariance
from msgs.values.arrays import require_finite
from msgs.values.frames import Pose2
from msgs.values.perception import PathClass, Peaks
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState

if TYPE_CHECKING:
    from msgs.values.radar import RangeAzimuthMap

#: Returns nearer to the ends of the scan are drawn inwards by beams that are not there.
EDGE_RAD = math.radians(10.0)
#: Times that beams are formed.
PASSES = 2


class DriveParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Prior knowledge of a drive; None: estimated from the drive."""

    prior: Pose2 = Pose2()
    clock_offset_s: float | None = None
    known_pose: bool = False

    def __post_init__(self) -> None:
        if self.clock_offset_s is not None:
            require_finite("clock_offset_s", self.clock_offset_s)


class Solved(msgspec.Struct, frozen=True, kw_only=True):
    """A mounting, the sightings it rests on, and what the recording lacks."""

    mounting: Mounting
    sightings: list[Sighting]
    loss: str | None


class Guess(msgspec.Struct, frozen=True, kw_only=True):
    """With what beams are freed from the vehicle's motion."""

    vehicle_from_radar: Pose2
    clock_offset_s: float
    yaw_rate_bias_rps: float
    speed_scale: float


def solve_drive(path: Path, params: DriveParams, on_scan: Callable[[], None] = lambda: None) -> Solved:
    """The mounting from a recording with `vehicle/state` and raw beams or peaks.

    Raises ValueError naming the file where it lacks one of them or the drive does not serve.
    """
    capture = Capture(path)
    states = list(capture.messages(("vehicle/state",)))
    if not states:
        raise ValueError(f"{path}: holds no vehicle/state: the vehicle's motion must be recorded with the walls")
    try:
        return _solve(capture, states, params, on_scan)
    except ValueError as error:
        raise ValueError(str(error) if str(path) in str(error) else f"{path}: {error}") from None


def _solve(capture: Capture, states: list[VehicleState], params: DriveParams, on_scan: Callable[[], None]) -> Solved:
    motion = Motion(states)
    held = (params.clock_offset_s, params.known_pose)
    has_beams = next(capture.messages(("radar/beam",)), None) is not None
    peaks = [] if has_beams else list(capture.messages(("perception/peaks",)))
    if peaks:
        sightings = [sighting for scan_peaks in peaks for sighting in sightings_of(scan_peaks, _limit_rad(capture))]
        mounting = solve_mounting(sightings, states, params.prior, *held)
        return Solved(mounting=mounting, sightings=sightings, loss=capture.loss)
    guess = Guess(
        vehicle_from_radar=params.prior,
        clock_offset_s=params.clock_offset_s or 0.0,
        yaw_rate_bias_rps=motion.rest_bias_rps,
        speed_scale=1.0,
    )
    for _ in range(PASSES):
        sightings = _formed(capture, motion, guess, on_scan)
        mounting = solve_mounting(sightings, states, params.prior, *held)
        guess = Guess(
            vehicle_from_radar=mounting.solved_pose,
            clock_offset_s=mounting.solved_clock_s,
            yaw_rate_bias_rps=mounting.yaw_rate_bias_rps,
            speed_scale=mounting.speed_scale,
        )
    return Solved(mounting=mounting, sightings=sightings, loss=capture.loss)


def _limit_rad(capture: Capture) -> float:
    """Azimuth up to which returns count."""
    return float(np.abs(capture.setup.beams.azimuth_rad).max()) - EDGE_RAD


def _formed(capture: Capture, motion: Motion, guess: Guess, on_scan: Callable[[], None]) -> list[Sighting]:
    """Sightings of all scans, their beams freed from the motion that the guess gives."""
    former = RaFormer(capture.setup, FormingParams(vehicle_from_radar=guess.vehicle_from_radar))
    detector, limit_rad = CfarDetector(capture.setup), _limit_rad(capture)
    # one motion holds for a scan: that of its middle ends where the vehicle does, at its end
    ahead_ns = ns_from_s(0.5 * capture.setup.radar.scan_period_s - guess.clock_offset_s)
    sightings: list[Sighting] = []

    def take(maps: list[RangeAzimuthMap]) -> None:
        for ra_map in maps:
            # at the ends of the drive no state says how the scan went on: its walls would be smeared
            if ra_map.ego_compensated:
                sightings.extend(sightings_of(detector.detect(ra_map), limit_rad))
            on_scan()

    for beam in capture.beams():
        state = motion.state_at(beam.stamp_ns + ahead_ns, guess.yaw_rate_bias_rps, guess.speed_scale)
        take(former.add(beam, state))
    take(former.flush())
    return sightings


def sightings_of(peaks: Peaks, limit_rad: float) -> list[Sighting]:
    """Straight walls among the direct returns of a scan, without those beyond an azimuth."""
    inside = (peaks.path_class == PathClass.LOS) & (np.abs(peaks.azimuth_rad) <= limit_rad)
    returns, walls = direct_structure(peaks.take(inside), GeometryParams())
    covariance_m2 = cartesian_covariance(peaks.range_m[inside], peaks.azimuth_rad[inside], peaks.covariance[inside])
    return [
        Sighting(
            stamp_ns=peaks.stamp_ns,
            normal=np.array(wall.normal),
            ends_m=np.array(wall.ends_m),
            points_m=returns.points_m[returns.wall == index],
            covariance_m2=covariance_m2[returns.wall == index],
        )
        for index, wall in enumerate(walls)
        if wall.curvature_per_m == 0.0
    ]


def draw_drive(solved: Solved, states: list[VehicleState], path: Path, title: str) -> None:
    """The walls' returns and the vehicle's way in the odometry frame, as calibrated."""
    from mirrorwave.plots.style import legend_below, new_figure, save

    mounting, motion = solved.mounting, Motion(states)
    figure = new_figure(9.0, 7.6)
    axes = figure.subplots()
    stamps = np.array([sighting.stamp_ns for sighting in solved.sightings], np.int64)
    poses = motion.poses(
        motion.seconds(stamps) - mounting.solved_clock_s, mounting.yaw_rate_bias_rps, mounting.speed_scale
    )
    axes.plot([], [], ".", color="0.6", label="returns of walls")
    for pose, sighting in zip(poses.tolist(), solved.sightings, strict=True):
        points_m = (Pose2(*pose) @ mounting.solved_pose).apply(sighting.points_m)
        axes.plot(*points_m.T, ".", color="0.6", markersize=3)
    axes.plot(*poses[:, :2].T, "g.-", label="vehicle")
    for index, wall in enumerate(mounting.walls):
        axes.plot(*np.array(wall.ends_m).T, "k-", linewidth=1.5, label=None if index else "walls")
    axes.set(xlabel="x [m]", ylabel="y [m]", title=title, aspect="equal")
    legend_below(axes, columns=3)
    axes.grid(alpha=0.3)
    save(figure, path)
