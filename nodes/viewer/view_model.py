"""The page's data: bus messages as compact JSON values and binary tiles. Pure functions.

JSON keeps the project's units and frames (metres, radians, radar frame), rounded to what a screen can show. A tile is
`TILE_HEADER` and one byte a cell (map), four cells a byte (mask), or two int16 a point (LiDAR slice, in steps of mm).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from models.scores.object_error import object_distances
from msgs.values.frames import Pose2
from msgs.values.lidar import LidarPoints, LidarSetup
from msgs.values.perception import BevFrame, HiddenObject, Peaks, SceneTruth, Track, TruthObject, Visibility
from msgs.values.radar import RadarSetup, RangeAzimuthMap
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState
from msgs.values.wording import counted
from nodes.inputs.view_latency import DEADLINE_S, Setup, last_beam_ns, scan_period_s
from nodes.viewer.side_sensors import CELL_M, slice_cells
from nodes.viewer.trails import Past, trail_m

#: Magic, version, kind, scan id, rows, columns, level of code 0 [0.01 dB], step per code [0.001 dB]; little-endian.
TILE_HEADER = struct.Struct("<2sBBIHHhH")
TILE_MAGIC, TILE_VERSION = b"MW", 1
TILE_MAP, TILE_MASK, TILE_POINTS = 1, 2, 3
#: Largest tile of a map: native range bins, azimuths at twice the sampling that a beam of 9 degrees needs many times.
TILE_ROWS, TILE_COLUMNS = 512, 128
#: Codes 0..255 span 102 dB: over the noise, or without a measured noise, down from the map's peak.
STEP_DB = 0.4
SPAN_DB = 255 * STEP_DB
#: Unit of the levels over the noise, for the modes of a map with another one.
_NOISE_UNITS = {"photons": "dB over ambient σ"}
#: A picture is old after this time, or once the next one is overdue where the sensor is slower.
OLD_S = 1.0
#: Maximum number of tracks on a page.
MAX_TRACKS = 100
#: An ellipse of two sigma holds 86 % of a plane's normal distribution.
ELLIPSE_SIGMAS = 2.0
#: The colour scale "cividis" at 33 even places: even in lightness, the same to colour-blind readers.
COLOURS = (
    "#00224e", "#00285b", "#002e6a", "#053371", "#1a386f", "#273e6e", "#32436d", "#3b496c", "#434e6c",
    "#4b546c", "#535a6d", "#5a5f6e", "#61656f", "#686a71", "#6f7073", "#767676", "#7d7c78", "#848279",
    "#8c8878", "#938e78", "#9b9476", "#a39a74", "#aba072", "#b4a76f", "#bcae6c", "#c4b468", "#cdbb63",
    "#d5c25e", "#dec958", "#e7d150", "#f0d846", "#f9e03a", "#fee838",
)  # fmt: skip


def view_json(
    frame: BevFrame, truth: SceneTruth | None, vehicle: VehicleState | None, past: Sequence[Past] = ()
) -> dict[str, Any]:
    """Return a bird's-eye view with its truth and the vehicle's motion; `past` holds its tracks' trails."""
    grid = frame.grid
    return {
        "type": "view",
        "scan_id": frame.scan_id,
        "stamp_s": round(s_from_ns(frame.stamp_ns), 3),
        "summary": summary_text(frame),
        "flags": list(frame.flags),
        "walls": [
            {
                "ends": [*_metres(wall.ends_m[0]), *_metres(wall.ends_m[1])],
                "normal": [round(part, 4) for part in wall.normal],
                "inliers": wall.inliers,
            }
            for wall in frame.walls
        ],
        "los": _metres(frame.los_points_m.ravel()),
        "points": [
            [*_metres((item.x_m, item.y_m, item.image_x_m, item.image_y_m)), round(item.score, 2), item.wall]
            for item in frame.points
        ],
        "objects": [_object_json(item, truth) for item in frame.objects],
        "tracks": [_track_json(item, past) for item in _by_urgency(frame.tracks)],
        "tracks_total": len(frame.tracks),
        "mask": {
            "x_min": grid.x_min_m,
            "y_min": grid.y_min_m,
            "cell": grid.cell_m,
            "rows": grid.rows,
            "columns": grid.columns,
            "rcs_dbsm": frame.visibility_rcs_dbsm,
        },
        "truth": None if truth is None else _truth_json(truth, frame),
        "vehicle": None
        if vehicle is None
        else {
            "speed_mps": round(vehicle.speed_mps, 2),
            "yaw_rate_rps": round(vehicle.yaw_rate_rps, 4),
            "valid": vehicle.valid,
            "reason": vehicle.reason,
        },
    }


def sensor_json(setup: Setup) -> dict[str, Any]:
    """Return the sensor of a page, and the duration of its scans."""
    name = "radar" if isinstance(setup, RadarSetup) else "LiDAR"
    return {
        "type": "sensor",
        "text": sensor_text(setup),
        "name": name,
        "scan_period_s": scan_period_s(setup),
        "scan_s": s_from_ns(last_beam_ns(setup)),
    }


def age_ms(stamp_ns: int, now_ns: int) -> float | None:
    """Return the time since a measurement began, however long; None for a stamp that this clock has yet to reach."""
    return round(1e-6 * (now_ns - stamp_ns), 1) if stamp_ns <= now_ns else None


def age_limits_ms(setup: Setup | None, was_late: bool) -> dict[str, float]:
    """Return the ages of a picture, from its first beam, above which it is late and above which it is old.

    One that came in time is live until the next one is overdue, one that came late (`was_late`) never is. A page
    compares the age, whatever arrives: `late_ms < age <= old_ms` is late. `setup` None: the default radar.
    """
    setup = setup or RadarSetup()
    overdue_ms = 1e3 * (s_from_ns(last_beam_ns(setup)) + DEADLINE_S + scan_period_s(setup))
    return {"late_ms": 0.0 if was_late else round(overdue_ms, 1), "old_ms": round(max(1e3 * OLD_S, overdue_ms), 1)}


def sensor_text(setup: Setup) -> str:
    """Return a sensor in a line: "X-band radar, 10 GHz, 25 beams", "SPAD LiDAR, 850 nm, 256 azimuths, 11 gates"."""
    if isinstance(setup, LidarSetup):
        gates = f", {setup.spad.gates} gates" if setup.spad.gates > 1 else ""
        return f"SPAD LiDAR, {1e9 * setup.spad.wavelength_m:.4g} nm, {setup.grid.azimuth_bins} azimuths{gates}"
    carrier_ghz = 1e-9 * setup.radar.carrier_hz
    # the X band is 8 to 12 GHz (IEEE 521)
    name = f"X-band radar, {carrier_ghz:.3g} GHz" if 8.0 <= carrier_ghz <= 12.0 else f"{carrier_ghz:.3g} GHz radar"
    if setup.array.digital:
        return f"{name}, {setup.array.columns * setup.array.rows} channels, digital"
    return f"{name}, {counted(len(setup.beams), 'beam')}"


def summary_text(frame: BevFrame) -> str:
    """Return one line for people and screen readers: "2 hidden objects at 11.6, 8.5 m and 16.3, 13.7 m"."""
    positions = [f"{item.x_m:.1f}, {item.y_m:.1f} m" for item in frame.objects]
    if not positions:
        return "no hidden object"
    count = "1 hidden object" if len(positions) == 1 else f"{len(positions)} hidden objects"
    joined = positions[0] if len(positions) == 1 else f"{'; '.join(positions[:-1])} and {positions[-1]}"
    return f"{count} at {joined}"


def ellipse(covariance: Sequence[Sequence[float]]) -> tuple[float, float, float]:
    """Return semi-axes [m] of `ELLIPSE_SIGMAS`, larger first, and the larger's direction [rad] in (-pi/2, pi/2]."""
    variances, vectors = np.linalg.eigh(np.array(covariance, np.float64))
    minor_m, major_m = ELLIPSE_SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    angle_rad = math.atan2(vectors[1, 1], vectors[0, 1])
    if angle_rad <= -0.5 * math.pi:
        angle_rad += math.pi
    elif angle_rad > 0.5 * math.pi:
        angle_rad -= math.pi
    return float(major_m), float(minor_m), angle_rad


def map_json(ra_map: RangeAzimuthMap, peaks: Peaks | None) -> dict[str, Any]:
    """Return geometry, scale and conditions of a map, and the peaks found in it if they are of this scan."""
    grid = ra_map.grid
    level_db, reference = map_level_db(ra_map)
    own_peaks = peaks if peaks is not None and peaks.scan_id == ra_map.scan_id else None
    return {
        "type": "map",
        "scan_id": ra_map.scan_id,
        "stamp_s": round(s_from_ns(ra_map.stamp_ns), 3),
        "range_bin_m": grid.range_bin_m,
        "range_bins": grid.range_bins,
        "azimuth_limit_deg": grid.azimuth_limit_deg,
        "azimuth_bins": grid.azimuth_bins,
        "pool": list(_pooling(grid.shape)),
        "reference": reference,
        "unit": "dB below peak" if reference == "peak" else _NOISE_UNITS.get(ra_map.mode, "dB over noise"),
        "peak_db": round(float(level_db.max()), 1),
        "mode": ra_map.mode,
        "ego_compensated": ra_map.ego_compensated,
        "incoherent_share": round(float(ra_map.incoherent.mean()), 3),
        "saturated_share": round(ra_map.saturated_share, 4),
        "missing_beams": list(ra_map.missing_beams),
        "peaks": None if own_peaks is None else _peaks_json(own_peaks),
    }


def map_tile(ra_map: RangeAzimuthMap) -> bytes:
    """Return the map's levels as codes: row r, column c is the strongest of its `pool` of cells.

    Code k is `floor + k STEP_DB`, rounded to the nearest; levels outside the span are clipped, a NaN is code 0.
    """
    level_db, reference = map_level_db(ra_map)
    floor_db = 0.0 if reference == "noise" else -SPAN_DB
    for axis, factor in enumerate(_pooling(ra_map.grid.shape)):
        if factor > 1:
            level_db = np.maximum.reduceat(level_db, np.arange(0, level_db.shape[axis], factor), axis=axis)
    codes = np.clip(np.rint((level_db - floor_db) / STEP_DB), 0, 255).astype(np.uint8)
    return _tile(TILE_MAP, ra_map.scan_id, codes.shape, floor_db, STEP_DB) + codes.tobytes()


def mask_tile(frame: BevFrame) -> bytes:
    """Return the observability mask, `Visibility` of four cells a byte, the first in the lowest two bits."""
    cells = np.minimum(frame.visibility, max(Visibility)).ravel()
    quads = np.pad(cells, (0, -len(cells) % 4)).reshape(-1, 4)
    packed = (quads << np.array([0, 2, 4, 6], np.uint8)).sum(axis=1, dtype=np.uint8)
    return _tile(TILE_MASK, frame.scan_id, frame.visibility.shape, 0.0, 0.0) + packed.tobytes()


def points_tile(points: LidarPoints, vehicle_from_radar: Pose2) -> bytes:
    """Return the slice of a cloud: x and y of each point, int16, in steps of `CELL_M`."""
    cells = slice_cells(points, vehicle_from_radar)
    return _tile(TILE_POINTS, points.scan_id, cells.shape, 0.0, CELL_M) + cells.tobytes()


def _tile(kind: int, scan_id: int, shape: tuple[int, ...], floor_db: float, step_db: float) -> bytes:
    level = round(100.0 * floor_db), round(1000.0 * step_db)
    return TILE_HEADER.pack(TILE_MAGIC, TILE_VERSION, kind, scan_id & 0xFFFF_FFFF, *shape, *level)


def map_level_db(ra_map: RangeAzimuthMap) -> tuple[np.ndarray, str]:
    """Return each cell's power in dB over the noise, or over the map's peak if no noise is known; and which of the two.

    Cells that are not finite count as empty: one bad cell must not spoil the scale of all others.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        power = np.square(ra_map.values.real) + np.square(ra_map.values.imag)
    power = np.where(np.isfinite(power), power, 0.0).astype(np.float64)
    noise = ra_map.noise_power_mw
    unit = noise if noise > 0.0 else float(power.max())
    smallest = np.finfo(np.float64).tiny
    level_db = 10.0 * (np.log10(np.maximum(power, smallest)) - math.log10(max(unit, smallest)))
    # an empty map has no meaningful peak: all its cells lie at the bottom of the scale
    return (level_db if unit > 0.0 else np.full_like(level_db, -SPAN_DB)), "noise" if noise > 0.0 else "peak"


def _pooling(shape: tuple[int, int]) -> tuple[int, int]:
    """Return the numbers of range bins and azimuth bins in one cell of a tile."""
    return -(-shape[0] // TILE_ROWS), -(-shape[1] // TILE_COLUMNS)


def _metres(values: Any) -> list[float]:
    return [round(float(value), 2) for value in values]


def _by_urgency(tracks: Sequence[Track]) -> list[Track]:
    """Return the tracks worth showing, in order of urgency: those that enter sight first, then the nearest."""
    return sorted(tracks, key=_urgency)[:MAX_TRACKS]


def _urgency(track: Track) -> tuple[float, float]:
    appears_s = track.time_to_appear_s
    return math.inf if appears_s is None else appears_s, math.hypot(track.x_m, track.y_m)


def _track_json(track: Track, past: Sequence[Past]) -> dict[str, Any]:
    appears_s, covariance = track.time_to_appear_s, track.velocity_cov_m2ps2
    return {
        "id": track.id,
        "at": _metres((track.x_m, track.y_m)),
        "ellipse": [round(part, 4) for part in ellipse(track.cov_m2)],
        "velocity": _metres((track.velocity_x_mps, track.velocity_y_mps)),
        "velocity_ellipse": None if covariance is None else [round(part, 4) for part in ellipse(covariance)],
        "age_s": round(track.age_s, 1),
        "appears_s": None if appears_s is None else round(appears_s, 1),
        "misses": track.misses,
        "existence": None if track.existence is None else round(track.existence, 3),
        "class": track.object_class,
        "trail": _metres(trail_m(track.id, past).ravel()),
    }


def _object_json(item: HiddenObject, truth: SceneTruth | None) -> dict[str, Any]:
    """Return a recovered object, with the nearest hidden true one and both errors (`evaluation.object_error`)."""
    return {
        "nearest": None if truth is None else _nearest_json(item, truth),
        "id": item.id,
        "at": _metres((item.x_m, item.y_m)),
        "centre": _metres(item.box_centre_m),
        "size": _metres((item.length_m, item.width_m)),
        "yaw": round(item.yaw_rad, 4),
        "score": round(item.score, 3),
        "class": item.object_class,
        "ellipse": [round(part, 4) for part in ellipse(item.cov_m2)],
        "points": item.points,
    }


def _nearest_json(item: HiddenObject, truth: SceneTruth) -> dict[str, Any] | None:
    """Return the hidden true object of the least face error; None if none is hidden."""
    hidden = [other for other in truth.objects if other.hidden]
    if not hidden:
        return None
    distances = object_distances([item], truth, hidden)
    nearest = int(distances.error_m[0].argmin())
    errors = {"face_error": distances.error_m[0, nearest], "centre_error": distances.centre_m[0, nearest]}
    return {"class": hidden[nearest].object_class, **{name: round(float(value), 2) for name, value in errors.items()}}


def _truth_json(truth: SceneTruth, frame: BevFrame) -> dict[str, Any]:
    return {
        "objects": [_truth_object_json(item, truth.stamp_ns, frame) for item in truth.objects],
        "surfaces": [
            {"role": item.role, "material": item.material, "line": _metres(sum(item.polyline_m, ()))}
            for item in truth.surfaces
        ],
    }


def _truth_object_json(item: TruthObject, stamp_ns: int, frame: BevFrame) -> dict[str, Any]:
    """Return a true object at the time the nearest recovered object was measured, else at the truth's stamp."""
    nearest = min(frame.objects, key=lambda other: math.hypot(other.x_m - item.x_m, other.y_m - item.y_m), default=None)
    elapsed_s = s_from_ns(nearest.stamp_ns - stamp_ns) if nearest is not None and nearest.stamp_ns else 0.0
    position = item.x_m + elapsed_s * item.velocity_x_mps, item.y_m + elapsed_s * item.velocity_y_mps
    return {
        "id": item.id,
        "class": item.object_class,
        "at": _metres(position),
        "size": _metres((item.length_m, item.width_m)),
        "yaw": round(item.yaw_rad, 4),
        "velocity": _metres((item.velocity_x_mps, item.velocity_y_mps)),
        "hidden": item.hidden,
    }


def _peaks_json(peaks: Peaks) -> list[list[float]]:
    """Return range [m], azimuth [rad], class, score of each peak."""
    return [
        [round(range_m, 2), round(azimuth_rad, 4), path_class, round(score, 2)]
        for range_m, azimuth_rad, path_class, score in zip(
            peaks.range_m.tolist(),
            peaks.azimuth_rad.tolist(),
            peaks.path_class.tolist(),
            peaks.score.tolist(),
            strict=True,
        )
    ]
