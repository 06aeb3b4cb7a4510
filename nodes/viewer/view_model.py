"""What the page is told: bus messages as compact JSON values and binary tiles. Pure functions.

JSON keeps the project's units and frames (metres, radians, radar frame), rounded to what a screen can show. A tile is
`TILE_HEADER` and one byte a cell (map) or four cells a byte (mask).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from models.evaluation.object_error import object_distances
from msgs.values.lidar import LidarSetup
from msgs.values.perception import BevFrame, HiddenObject, Peaks, SceneTruth, Track, TruthObject, Visibility
from msgs.values.radar import RadarSetup, RangeAzimuthMap
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState
from msgs.values.wording import counted
from nodes.inputs.view_latency import Setup, last_beam_ns, scan_period_s
from nodes.viewer.trails import Past, trail_m

#: Magic, version, kind, scan id, rows, columns, level of code 0 [0.01 dB], step per code [0.001 dB]; little-endian.
TILE_HEADER = struct.Struct("<2sBBIHHhH")
TILE_MAGIC, TILE_VERSION = b"MW", 1
TILE_MAP, TILE_MASK = 1, 2
#: Largest tile of a map: native range bins, azimuths at twice what a beam of 9 degrees needs many times over.
TILE_ROWS, TILE_COLUMNS = 512, 128
#: Codes 0..255 span 102 dB: over the noise, or where no noise was measured, down from the map's peak.
STEP_DB = 0.4
SPAN_DB = 255 * STEP_DB
#: What levels over the noise are told in, by the mode of a map where it is another.
_NOISE_UNITS = {"photons": "dB over ambient σ"}
#: Tracks told to a page at most: more than anybody can look at.
MAX_TRACKS = 100
#: Fields of a true object that are no measures.
_NO_NUMBERS = ("id", "object_class", "hidden")
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
    """A bird's-eye view with the truth and the vehicle's motion that belong to it; `past` holds its tracks' trails."""
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
            [*_metres((one.x_m, one.y_m, one.image_x_m, one.image_y_m)), round(one.score, 2), one.wall]
            for one in frame.points
        ],
        "objects": [_object_json(one, truth) for one in _placed(frame)],
        "tracks": [_track_json(one, past) for one in _pressing(frame.tracks)],
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
        "vehicle": None if vehicle is None else _vehicle_json(vehicle),
    }


def sensor_json(setup: Setup) -> dict[str, Any]:
    """Which sensor a page looks through, and how long its scans take."""
    name = "radar" if isinstance(setup, RadarSetup) else "LiDAR"
    return {
        "type": "sensor",
        "text": sensor_text(setup),
        "name": name,
        "scan_period_s": scan_period_s(setup),
        "scan_s": s_from_ns(last_beam_ns(setup)),
    }


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
    places = [f"{one.x_m:.1f}, {one.y_m:.1f} m" for one in _placed(frame)]
    if not places:
        return "no hidden object"
    count = "1 hidden object" if len(places) == 1 else f"{len(places)} hidden objects"
    joined = places[0] if len(places) == 1 else f"{'; '.join(places[:-1])} and {places[-1]}"
    return f"{count} at {joined}"


def ellipse(covariance: Sequence[Sequence[float]]) -> tuple[float, float, float]:
    """Semi-axes [m] of `ELLIPSE_SIGMAS`, the larger first, and the larger one's direction [rad] in (-pi/2, pi/2].

    Nothing, where the covariance is not finite.
    """
    if not np.isfinite(covariance).all():
        return 0.0, 0.0, 0.0
    variances, vectors = np.linalg.eigh(np.array(covariance, np.float64))
    minor_m, major_m = ELLIPSE_SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    angle_rad = math.atan2(vectors[1, 1], vectors[0, 1])
    if angle_rad <= -0.5 * math.pi:
        angle_rad += math.pi
    elif angle_rad > 0.5 * math.pi:
        angle_rad -= math.pi
    return float(major_m), float(minor_m), angle_rad


def map_json(ra_map: RangeAzimuthMap, peaks: Peaks | None) -> dict[str, Any]:
    """Return geometry, scale and conditions of a map, and the peaks found in it where they are this scan's."""
    grid = ra_map.grid
    level_db, reference = _level_db(ra_map)
    mine = peaks if peaks is not None and peaks.scan_id == ra_map.scan_id else None
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
        "peaks": None if mine is None else _peaks_json(mine),
    }


def map_tile(ra_map: RangeAzimuthMap) -> bytes:
    """Return the map's levels as codes: row r, column c is the strongest of its `pool` of cells.

    Code k stands for `floor + k STEP_DB`, rounded to the nearest; what lies outside the span is clipped, what is not a
    number is code 0.
    """
    level_db, reference = _level_db(ra_map)
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


def _tile(kind: int, scan_id: int, shape: tuple[int, ...], floor_db: float, step_db: float) -> bytes:
    level = round(100.0 * floor_db), round(1000.0 * step_db)
    return TILE_HEADER.pack(TILE_MAGIC, TILE_VERSION, kind, scan_id & 0xFFFF_FFFF, *shape, *level)


def _level_db(ra_map: RangeAzimuthMap) -> tuple[np.ndarray, str]:
    """Power of each cell in dB over the noise, or over the map's peak where no noise is known; and which of the two.

    Cells that are not finite count as empty: one bad cell must not take the scale from all others.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        power = np.square(ra_map.values.real) + np.square(ra_map.values.imag)
    power = np.where(np.isfinite(power), power, 0.0).astype(np.float64)
    noise = ra_map.noise_power_mw
    unit = noise if noise > 0.0 else float(power.max())
    smallest = np.finfo(np.float64).tiny
    level_db = 10.0 * (np.log10(np.maximum(power, smallest)) - math.log10(max(unit, smallest)))
    # an empty map has no peak to speak of: all its cells lie at the bottom of the scale
    return (level_db if unit > 0.0 else np.full_like(level_db, -SPAN_DB)), "noise" if noise > 0.0 else "peak"


def _pooling(shape: tuple[int, int]) -> tuple[int, int]:
    """Return range bins and azimuth bins that go into one cell of a tile."""
    return -(-shape[0] // TILE_ROWS), -(-shape[1] // TILE_COLUMNS)


def _metres(values: Any) -> list[float]:
    return [round(float(value), 2) for value in values]


def _placed(frame: BevFrame) -> list[HiddenObject]:
    """Return objects that have a place to be shown at: the bus lets any number through."""
    return [
        one
        for one in frame.objects
        if all(map(math.isfinite, (one.x_m, one.y_m, one.length_m, one.width_m, one.yaw_rad, one.score)))
    ]


def _pressing(tracks: Sequence[Track]) -> list[Track]:
    """Return the tracks worth showing, in order of urgency: who comes into sight first, then the nearest."""
    placed = [one for one in tracks if _has_place(one)]
    return sorted(placed, key=_urgency)[:MAX_TRACKS]


def _urgency(one: Track) -> tuple[float, float]:
    appears_s = _appears_s(one)
    return math.inf if appears_s is None else appears_s, math.hypot(one.x_m, one.y_m)


def _has_place(one: Track) -> bool:
    return all(map(math.isfinite, (one.x_m, one.y_m, one.velocity_x_mps, one.velocity_y_mps, one.age_s)))


def _appears_s(one: Track) -> float | None:
    appears_s = one.time_to_appear_s
    return None if appears_s is None or not math.isfinite(appears_s) else appears_s


def _track_json(one: Track, past: Sequence[Past]) -> dict[str, Any]:
    appears_s, covariance = _appears_s(one), one.velocity_cov_m2ps2
    return {
        "id": one.id,
        "at": _metres((one.x_m, one.y_m)),
        "ellipse": [round(part, 4) for part in ellipse(one.cov_m2)],
        "velocity": _metres((one.velocity_x_mps, one.velocity_y_mps)),
        "velocity_ellipse": None if covariance is None else [round(part, 4) for part in ellipse(covariance)],
        "age_s": round(one.age_s, 1),
        "appears_s": None if appears_s is None else round(appears_s, 1),
        "misses": one.misses,
        "trail": _metres(trail_m(one.id, past).ravel()),
    }


def _object_json(one: HiddenObject, truth: SceneTruth | None) -> dict[str, Any]:
    """A recovered object, with the nearest hidden true one and both errors (`models.evaluation.object_error`)."""
    return {
        "nearest": None if truth is None else _nearest_json(one, truth),
        "id": one.id,
        "at": _metres((one.x_m, one.y_m)),
        "size": _metres((one.length_m, one.width_m)),
        "yaw": round(one.yaw_rad, 4),
        "score": round(one.score, 3),
        "ellipse": [round(part, 4) for part in ellipse(one.cov_m2)],
        "points": one.points,
    }


def _nearest_json(one: HiddenObject, truth: SceneTruth) -> dict[str, Any] | None:
    """Return the hidden true object of the least face error; None where none is hidden, or none has a place."""
    hidden = [other for other in truth.objects if other.hidden and _is_whole(other)]
    distances = object_distances([one], truth, hidden)
    if not hidden or not np.isfinite(distances.error_m).all():
        return None
    nearest = int(distances.error_m[0].argmin())
    errors = {"face_error": distances.error_m[0, nearest], "centre_error": distances.centre_m[0, nearest]}
    return {"class": hidden[nearest].object_class, **{name: round(float(value), 2) for name, value in errors.items()}}


def _is_whole(one: TruthObject) -> bool:
    """Return whether all numbers of a true object are such: the bus lets any through."""
    return all(math.isfinite(getattr(one, name)) for name in one.__struct_fields__ if name not in _NO_NUMBERS)


def _truth_json(truth: SceneTruth, frame: BevFrame) -> dict[str, Any]:
    return {
        "objects": [_truth_object_json(one, truth.stamp_ns, frame) for one in truth.objects],
        "surfaces": [
            {"role": one.role, "material": one.material, "line": _metres(sum(one.polyline_m, ()))}
            for one in truth.surfaces
        ],
    }


def _truth_object_json(one: TruthObject, stamp_ns: int, frame: BevFrame) -> dict[str, Any]:
    """A true object where it was when the recovered object nearest to it was measured, else at the truth's stamp."""
    nearest = min(frame.objects, key=lambda other: math.hypot(other.x_m - one.x_m, other.y_m - one.y_m), default=None)
    elapsed_s = s_from_ns(nearest.stamp_ns - stamp_ns) if nearest is not None and nearest.stamp_ns else 0.0
    place = one.x_m + elapsed_s * one.velocity_x_mps, one.y_m + elapsed_s * one.velocity_y_mps
    return {
        "id": one.id,
        "class": one.object_class,
        "at": _metres(place),
        "size": _metres((one.length_m, one.width_m)),
        "yaw": round(one.yaw_rad, 4),
        "velocity": _metres((one.velocity_x_mps, one.velocity_y_mps)),
        "hidden": one.hidden,
    }


def _vehicle_json(vehicle: VehicleState) -> dict[str, Any]:
    return {
        "speed_mps": round(vehicle.speed_mps, 2),
        "yaw_rate_rps": round(vehicle.yaw_rate_rps, 4),
        "valid": vehicle.valid,
        "reason": vehicle.reason,
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
