"""Detections of a radar from columns of numbers, whatever a file calls them: names, units, signs, limits.

Frame: x forward, y left, azimuth counter-clockwise from x (REP-103), elevation up; radial speed positive away from the
radar. A column that counts the other way is `negated`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, Literal

import msgspec
import numpy as np

from msgs.values.arrays import require_finite, require_positive
from msgs.values.detections import MAX_DETECTIONS, OPTIONAL_COLUMNS, RadarDetections
from msgs.values.frames import Mounting, polar_from_xy

#: Columns by their names, or by their numbers from 0 where a file has no names.
Columns = Mapping[str | int, np.ndarray]

_LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3}
_ANGLE = {"rad": 1.0, "deg": math.pi / 180.0}
_SPEED = {"m/s": 1.0, "km/h": 1.0 / 3.6}
#: Units of each quantity and what makes them SI, dBsm or dB; the first holds where none is named.
UNITS: dict[str, dict[str, float]] = {
    **dict.fromkeys(("range", "x", "y", "z", "range_std", "x_std", "y_std"), _LENGTH),
    **dict.fromkeys(("azimuth", "elevation", "azimuth_std", "elevation_std"), _ANGLE),
    **dict.fromkeys(("radial_speed", "radial_speed_std"), _SPEED),
    "rcs": {"dBsm": 1.0},
    "snr": {"dB": 1.0},
}
#: Nanoseconds of each unit of a stamp.
STAMP_UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
#: Fields of `RadarDetections` that a file may leave out, and the quantities that they come from.
_OPTIONAL = {
    "elevation_rad": "elevation", "elevation_std_rad": "elevation_std", "radial_speed_mps": "radial_speed",
    "radial_speed_std_mps": "radial_speed_std", "rcs_dbsm": "rcs", "snr_db": "snr",
}  # fmt: skip


class Source(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a quantity stands: a column, or one value for all detections."""

    #: Name in the head of the file, field of a cloud, or number from 0.
    column: str | int | None = None
    value: float | None = None
    #: Empty: SI (m, rad, m/s, s), dBsm, dB.
    unit: str = ""
    #: The file counts the other way: azimuth clockwise, y to the right, speed positive towards the radar.
    negated: bool = False

    def __post_init__(self) -> None:
        if (self.column is None) == (self.value is None):
            raise ValueError("either column or value must be given")
        require_finite("value", self.value or 0.0)


class TableFormat(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How lines of a text file become rows."""

    delimiter: str = ","
    #: Before the decimals of a number; nothing else is taken for a part of it.
    decimal: Literal[".", ","] = "."
    #: Lines that begin with this are passed over; empty: none are.
    comment: str = "#"
    #: Lines before the head, whatever they hold.
    skip_lines: int = 0
    #: The first row names the columns.
    header: bool = True

    def __post_init__(self) -> None:
        if len(self.delimiter) != 1 or self.delimiter in '\r\n"' or not self.delimiter.isascii():
            raise ValueError(f"delimiter must be one character other than a quote or a line end: {self.delimiter!r}")
        if self.decimal == self.delimiter:
            raise ValueError(f"decimal must not be the delimiter, got {self.decimal!r} for both")
        if not 0 <= self.skip_lines <= 1_000_000:
            raise ValueError(f"skip_lines must be 0..1000000, got {self.skip_lines!r}")


class Sensors(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Sensors that share a table: the column that names them, and where each stands."""

    column: str
    mountings: dict[str, Mounting] = {}


class DetectionMapping(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the columns of a file mean: range and azimuth or x and y, their standard deviations, and what else is there.

    Raises `ValueError` for a position or standard deviations that are not whole, and for units that a quantity lacks.
    """

    sensor: str = ""
    range: Source | None = None
    azimuth: Source | None = None
    elevation: Source | None = None
    x: Source | None = None
    y: Source | None = None
    z: Source | None = None
    radial_speed: Source | None = None
    #: The sensor takes its own motion off the radial speed.
    over_ground: bool = False
    rcs: Source | None = None
    snr: Source | None = None
    range_std: Source | None = None
    azimuth_std: Source | None = None
    x_std: Source | None = None
    y_std: Source | None = None
    elevation_std: Source | None = None
    radial_speed_std: Source | None = None
    #: Time of a row, or the value of a table that is one scan; messages of bags bring their own.
    stamp: Source | None = None
    #: Rows in a row that agree here are a scan; None: those of one stamp.
    scan: Source | None = None
    #: Table of a file of HDF5, and the sensors in it, of which one is read.
    dataset: str = ""
    sensors: Sensors | None = None
    max_range_m: float = 1000.0
    table: TableFormat = TableFormat()
    mounting: Mounting = Mounting()

    def __post_init__(self) -> None:
        self._require_whole(("range", "azimuth"), ("x", "y"), "a position")
        if (self.z is not None and self.x is None) or (self.elevation is not None and self.range is None):
            raise ValueError("elevation must stand beside range and azimuth, z beside x and y")
        self._require_whole(("range_std", "azimuth_std"), ("x_std", "y_std"), "a standard deviation")
        for name, units in UNITS.items():
            source = getattr(self, name)
            if source is not None and source.unit and source.unit not in units:
                raise ValueError(f"{name}.unit must be one of {', '.join(units)}, got {source.unit!r}")
        if self.stamp is not None and (self.stamp.unit or "s") not in STAMP_UNITS:
            raise ValueError(f"stamp.unit must be one of {', '.join(STAMP_UNITS)}, got {self.stamp.unit!r}")
        if self.scan is not None and self.scan.column is None:
            raise ValueError("scan must be a column")
        require_positive("max_range_m", self.max_range_m)

    def _require_whole(self, polar: tuple[str, str], plane: tuple[str, str], noun: str) -> None:
        given = [name for name in (*polar, *plane) if getattr(self, name) is not None]
        if tuple(given) not in (polar, plane):
            has = ", ".join(given) or "nothing"
            raise ValueError(f"{noun} must be {' and '.join(polar)}, or {' and '.join(plane)}; given: {has}")

    @property
    def columns(self) -> dict[str, str | int]:
        """Columns of the quantities of a detection, by quantity."""
        sources = {name: getattr(self, name) for name in UNITS}
        return {name: source.column for name, source in sources.items() if source and source.column is not None}


def missing_columns(mapping: DetectionMapping, known: list[str | int]) -> str:
    """Return the rule that the first column breaks which is not among the known ones; empty where all are."""
    wanted = mapping.columns
    for name in ("stamp", "scan"):
        if (source := getattr(mapping, name)) is not None and source.column is not None:
            wanted[name] = source.column
    for name, column in wanted.items():
        if column not in known:
            return f"{name}.column must be one of {', '.join(map(str, known))}, got {column!r}"
    return ""


def polar_covariance(range_m: np.ndarray, azimuth_rad: np.ndarray, variance_m2: np.ndarray) -> np.ndarray:
    """Return the covariance [N, 2, 2] of range [m] and azimuth [rad] for variances [N, 2] along x and y.

    First order: d range = cos dx + sin dy, d azimuth = (cos dy - sin dx) / range.
    """
    cos, sin = np.cos(azimuth_rad), np.sin(azimuth_rad)
    jacobian = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1) / range_m[:, None]], -2)
    return np.asarray((jacobian * variance_m2[:, None, :]) @ jacobian.transpose(0, 2, 1))


def detections_of(
    columns: Columns, mapping: DetectionMapping, stamp_ns: int, scan_id: int
) -> tuple[RadarDetections, Counter[str]]:
    """Return a scan's detections, and by reason how many rows, or values of rows, were left out.

    Rows without a whole position, standard deviation or place within the limits are; an optional value that is no
    number becomes NaN. Columns are float64 [N]; raises `ValueError` naming the field of a column that is absent.
    """
    if rule := missing_columns(msgspec.structs.replace(mapping, stamp=None, scan=None), list(columns)):
        raise ValueError(rule)
    left_out: Counter[str] = Counter()
    values = _si_values(columns, mapping)
    with np.errstate(over="ignore", invalid="ignore"):
        _place(values)
        keep = _within_limits(values, mapping.max_range_m, left_out)
    values = {name: column[keep][:MAX_DETECTIONS] for name, column in values.items()}
    if (excess := int(keep.sum()) - MAX_DETECTIONS) > 0:
        left_out[f"more than {MAX_DETECTIONS} in a scan"] += excess
    optional: dict[str, Any] = {
        field: _optional(values, name, OPTIONAL_COLUMNS[field], left_out) for field, name in _OPTIONAL.items()
    }
    range_m, azimuth_rad = values["range"], values["azimuth"]
    detections = RadarDetections(
        stamp_ns=stamp_ns,
        scan_id=scan_id,
        sensor=mapping.sensor,
        range_m=range_m,
        azimuth_rad=azimuth_rad,
        covariance=_covariance(values),
        **optional,
        over_ground=mapping.over_ground,
        vehicle_from_radar=mapping.mounting.vehicle_from_radar,
    )
    return detections, left_out


def _si_values(columns: Columns, mapping: DetectionMapping) -> dict[str, np.ndarray]:
    count = len(next(iter(columns.values()), ()))
    values = {}
    for name, units in UNITS.items():
        source: Source | None = getattr(mapping, name)
        if source is None:
            continue
        raw = np.full(count, source.value) if source.column is None else columns[source.column]
        scale = units[source.unit or next(iter(units))]
        with np.errstate(over="ignore"):
            values[name] = np.asarray(raw, np.float64) * (-scale if source.negated else scale)
    return values


def _place(values: dict[str, np.ndarray]) -> None:
    """Put range, azimuth in (-pi, pi] and elevation beside what they follow from."""
    if "x" in values:
        points_m = np.stack([values["x"], values["y"]], axis=-1)
        values["range"], values["azimuth"] = polar_from_xy(points_m)
        if "z" in values:
            values["elevation"] = np.arctan2(values["z"], values["range"])
            values["range"] = np.hypot(values["range"], values["z"])
    else:
        values["azimuth"] = math.pi - (math.pi - values["azimuth"]) % (2.0 * math.pi)


def _within_limits(values: dict[str, np.ndarray], max_range_m: float, left_out: Counter[str]) -> np.ndarray:
    """Return which rows are used, bool [N]; each other row counts under the first limit that it breaks."""
    keep = np.ones(len(values["range"]), bool)
    for reason, inside in _limits(values, max_range_m):
        if dropped := int((keep & ~inside).sum()):
            left_out[reason] += dropped
        keep &= inside
    return keep


def _limits(values: dict[str, np.ndarray], max_range_m: float) -> Iterator[tuple[str, np.ndarray]]:
    place = [name for name in ("range", "azimuth", "range_std", "azimuth_std", "x_std", "y_std") if name in values]
    for name in place:
        yield f"{name} is no number", np.isfinite(values[name])
    yield f"range is not within 0..{max_range_m:g} m", (values["range"] > 0.0) & (values["range"] <= max_range_m)
    # squares must stay above the smallest double and below the message's limit
    for name in place[2:]:
        yield f"{name} is not within 1e-9..1e5", (values[name] >= 1e-9) & (values[name] <= 1e5)
    if "elevation" in values:
        yield "elevation is not within +-90 deg", ~(np.abs(values["elevation"]) > math.pi / 2)


def _covariance(values: dict[str, np.ndarray]) -> np.ndarray:
    if "range_std" in values:
        variances = np.stack([values["range_std"], values["azimuth_std"]], axis=-1) ** 2
        return np.asarray(variances[:, :, None] * np.eye(2))
    variance_m2 = np.stack([values["x_std"], values["y_std"]], axis=-1) ** 2
    return polar_covariance(values["range"], values["azimuth"], variance_m2)


def _optional(
    values: dict[str, np.ndarray], name: str, limits: tuple[float, float], left_out: Counter[str]
) -> np.ndarray | None:
    if name not in values:
        return None
    least, greatest = limits
    # NaN is what a sensor writes where it measured nothing; anything else that cannot be is lost
    absurd = (values[name] < least) | (values[name] > greatest)
    if absurd.any():
        left_out[f"{name} is not within {least:g}..{greatest:g}: the value alone"] += int(absurd.sum())
    return np.where(absurd, np.nan, values[name])
