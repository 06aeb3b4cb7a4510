"""Values of LiDARs: a single-photon one (parameters of Table 2, set-up, photon histograms), and clouds of any other."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from msgs.values.arrays import MAX_STAMP_NS, Array, Checked, Count, LengthM, StampNs
from msgs.values.frames import Pose2
from msgs.values.radar import RangeAzimuthGrid
from msgs.values.units import PLANCK_J_S, SPEED_OF_LIGHT_MPS

#: Permitted range of each parameter, ends included. Far beyond any device; within them memory and time are bounded,
#: and every quantity is a finite double.
SPAD_LIMITS: dict[str, tuple[float, float]] = {
    "wavelength_m": (1e-9, 1e-3),
    "average_power_w": (1e-30, 1e9),
    "repetition_rate_hz": (1.0, 1e12),
    "measurement_time_s": (1e-12, 1e3),
    "irf_fwhm_s": (1e-18, 1.0),
    "jitter_rms_s": (0.0, 1.0),
    "tail_share": (0.0, 1.0),
    "tail_s": (0.0, 1.0),
    "dead_time_s": (0.0, 1e6),
    "quantum_efficiency": (1e-30, 1.0),
    "aperture_radius_m": (1e-9, 1e3),
    "transmit_efficiency": (1e-30, 1.0),
    "receive_efficiency": (1e-30, 1.0),
    "ambient_rate_hz": (0.0, 1e15),
    "bins": (1, 1 << 14),
    "tick_s": (0.0, 1.0),
    "divergence_rad": (1e-9, math.pi),
    "gates": (1, 1 << 14),
}
SPAD_WORDS: dict[str, tuple[str, ...]] = {"tick_from": ("pulse", "run"), "arming": ("free", "gated")}
#: Counts of one measurement are 32 bits wide.
MAX_PULSES = (1 << 32) - 1
#: Shortest pulse and tick as shares of the period: times within a period are known to 2e-16 of it.
SHORTEST_PULSE = 1e-12
#: Shortest tail as a share of the pulse's standard deviation: a shorter one does not show.
SHORTEST_TAIL = 1e-3
LONGEST_SCAN_S = 1e6


class SpadParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A pulsed laser and one single-photon detector, scanned together; defaults are Table 2."""

    wavelength_m: float = 850e-9
    average_power_w: float = 1.6e-3
    repetition_rate_hz: float = 15e6
    #: Of one azimuth.
    measurement_time_s: float = 0.03
    #: Pulse and receiver together, full width at half maximum; the detector's own jitter, rms, comes on top.
    irf_fwhm_s: float = 200e-12
    jitter_rms_s: float = 16e-12
    #: Share of the signal's detections that come late by an exponential delay, of mean `tail_s`: carriers that diffuse
    #: into the detector's junction. Not in Table 2; half of them, 0.25 ns late on average, fit real transients.
    tail_share: float = 0.0
    tail_s: float = 0.0
    dead_time_s: float = 4e-9
    quantum_efficiency: float = 0.28
    aperture_radius_m: float = 5e-3
    transmit_efficiency: float = 0.6
    receive_efficiency: float = 0.6
    #: Detections of ambient light and dark counts a second, while the detector is armed.
    ambient_rate_hz: float = 3e7
    #: Histogram bins of one period.
    bins: int = 512
    #: Time stamps are whole multiples of this; 0: not quantised.
    tick_s: float = 55e-12
    #: Full angle of the beam and of the receiver's view; not in Table 2, an engineering choice.
    divergence_rad: float = 2e-3
    #: Origin of the ticks: the laser pulse (start-stop), or the start of the whole measurement.
    tick_from: Literal["pulse", "run"] = "pulse"
    #: "free": always on, so that the dead time of one period reaches into the next. "gated": re-armed at every pulse.
    arming: Literal["free", "gated"] = "free"
    #: The period is cut into so many equal gates, each measured with its share of the pulses and blind before it
    #: opens; more than one needs "gated".
    gates: int = 1

    def __post_init__(self) -> None:
        for name, (minimum, maximum) in SPAD_LIMITS.items():
            if not minimum <= getattr(self, name) <= maximum:
                raise ValueError(f"spad.{name} must lie in {minimum:g}..{maximum:g}, got {getattr(self, name)!r}")
        for name, words in SPAD_WORDS.items():
            if getattr(self, name) not in words:
                raise ValueError(f"spad.{name} must be {' or '.join(map(repr, words))}, got {getattr(self, name)!r}")
        if not 1 <= self.pulses <= MAX_PULSES:
            raise ValueError(
                f"spad.measurement_time_s must last 1 to {MAX_PULSES} periods of {self.period_s:g} s, "
                f"got {self.measurement_time_s!r}"
            )
        if self.timing_rms_s < SHORTEST_PULSE * self.period_s:
            raise ValueError(
                f"spad.irf_fwhm_s must be longer or the period shorter: of {self.period_s:g} s at least a share of "
                f"{SHORTEST_PULSE:g}, got {self.irf_fwhm_s!r}"
            )
        if self.tail_s > self.period_s:
            raise ValueError(f"spad.tail_s must not exceed the period, {self.period_s!r} s, got {self.tail_s!r}")
        if self.tail_share > 0.0 and self.tail_s < SHORTEST_TAIL * self.timing_rms_s:
            raise ValueError(
                f"spad.tail_s must be at least {SHORTEST_TAIL:g} of the pulse's {self.timing_rms_s:g} s rms where "
                f"spad.tail_share is not 0, got {self.tail_s!r}"
            )
        if 0.0 < self.tick_s < SHORTEST_PULSE * self.period_s:
            raise ValueError(
                f"spad.tick_s must be 0 or at least a share of {SHORTEST_PULSE:g} of the period, {self.period_s:g} s, "
                f"got {self.tick_s!r}"
            )
        if self.tick_s > self.period_s:
            raise ValueError(f"spad.tick_s must not exceed the period, {self.period_s!r} s, got {self.tick_s!r}")
        if self.gates > 1 and self.arming != "gated":
            raise ValueError(f"spad.gates must be 1 unless spad.arming is 'gated', got {self.gates!r}")
        if self.gates > min(self.pulses, self.bins):
            raise ValueError(
                f"spad.gates must not exceed the {self.pulses} pulses or the {self.bins} bins, got {self.gates!r}"
            )

    @property
    def period_s(self) -> float:
        """T_rep = 1 / f_rep."""
        return 1.0 / self.repetition_rate_hz

    @property
    def bin_s(self) -> float:
        """Width of a histogram bin, 1 / (f_rep N_bin)."""
        return self.period_s / self.bins

    @property
    def pulses(self) -> int:
        """Whole periods in the measurement of one azimuth."""
        # 0.03 s times 15 MHz must be 450 000, not one less
        return math.floor(self.measurement_time_s * self.repetition_rate_hz * (1.0 + 1e-12))

    @property
    def pulse_energy_j(self) -> float:
        """E_p = P_avg / f_rep."""
        return self.average_power_w / self.repetition_rate_hz

    @property
    def photon_energy_j(self) -> float:
        """E_ph = h c / lambda."""
        return PLANCK_J_S * SPEED_OF_LIGHT_MPS / self.wavelength_m

    @property
    def unambiguous_range_m(self) -> float:
        """R_amb = c / (2 f_rep): 9.99 m with the defaults."""
        return 0.5 * SPEED_OF_LIGHT_MPS * self.period_s

    @property
    def timing_rms_s(self) -> float:
        """Standard deviation of a signal photon's time: pulse, receiver and jitter together, without the tail."""
        return math.hypot(self.irf_fwhm_s / math.sqrt(8.0 * math.log(2.0)), self.jitter_rms_s)


class LidarSetup(Checked, frozen=True, kw_only=True):
    """Set-up that a receiver needs before the first histograms: the LiDAR and its directions (topic `lidar/setup`)."""

    label: ClassVar[str] = "lidar"

    stamp_ns: StampNs = 0
    spad: SpadParams = SpadParams()
    #: Its columns are the measured azimuths, in this order.
    grid: RangeAzimuthGrid = RangeAzimuthGrid()
    lidar_height_m: Annotated[float, msgspec.Meta(gt=0.0, le=1e4)] = 1.0
    #: Time from the first azimuth of a scan to the first of the next; None: as long as the measurements take.
    scan_period_s: float | None = None
    vehicle_from_lidar: Pose2 = Pose2()

    def __post_init__(self) -> None:
        super().__post_init__()
        shortest_s = self.grid.azimuth_bins * self.spad.measurement_time_s
        if self.scan_period_s is not None and not shortest_s * (1.0 - 1e-9) <= self.scan_period_s <= LONGEST_SCAN_S:
            raise ValueError(
                f"lidar.scan_period_s must be no shorter than {self.grid.azimuth_bins} measurements, {shortest_s:g} s, "
                f"and no longer than {LONGEST_SCAN_S:g} s, got {self.scan_period_s!r}"
            )

    @property
    def period_s(self) -> float:
        """Time from scan to scan."""
        if self.scan_period_s is not None:
            return self.scan_period_s
        return self.grid.azimuth_bins * self.spad.measurement_time_s


class PhotonHistograms(Checked, frozen=True, kw_only=True, eq=False):
    """First photons of every azimuth of one scan (topic `lidar/histograms`)."""

    label: ClassVar[str] = "histograms"

    stamp_ns: StampNs
    scan_id: Count
    #: Photons per azimuth and time bin of the period, uint32 [azimuth, bins].
    counts: Annotated[np.ndarray, Array("<u4", (None, None))]
    #: Start of the measurement of each azimuth, int64 [azimuth].
    azimuth_stamp_ns: Annotated[np.ndarray, Array("<i8", ("counts",), -MAX_STAMP_NS, MAX_STAMP_NS)]


#: Types of a point's fields, by name, as numpy writes them.
POINT_TYPES: dict[str, str] = {
    "int8": "|i1", "uint8": "|u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4",
    "int64": "<i8", "uint64": "<u8", "float32": "<f4", "float64": "<f8",
}  # fmt: skip
#: The largest cloud: 131,072 points of 120 bytes, or 262,144 of 60.
MAX_CLOUD_BYTES = 15 << 20
MAX_POINT_FIELDS, MAX_NAME_LENGTH = 64, 64
MAX_POSITION_M = 1e6


class PointField(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A field of every point of a cloud: where it lies in the point's bytes, little-endian."""

    name: str
    #: From the start of the point, in bytes.
    offset: int
    #: One of `POINT_TYPES`.
    datatype: str
    #: Values of one point.
    count: int = 1

    def __post_init__(self) -> None:
        if not 1 <= len(self.name) <= MAX_NAME_LENGTH:
            raise ValueError(f"field.name must have 1..{MAX_NAME_LENGTH} characters, got {len(self.name)}")
        if self.datatype not in POINT_TYPES:
            raise ValueError(f"field {self.name!r} must be of type {', '.join(POINT_TYPES)}, got {self.datatype!r}")
        if not (0 <= self.offset <= MAX_CLOUD_BYTES and 1 <= self.count <= MAX_CLOUD_BYTES):
            raise ValueError(
                f"field {self.name!r} must have offset and count of 0 and 1 to {MAX_CLOUD_BYTES}, "
                f"got {self.offset} and {self.count}"
            )

    @property
    def end(self) -> int:
        """First byte of the point after the field."""
        return self.offset + self.count * np.dtype(POINT_TYPES[self.datatype]).itemsize


class LidarPoints(Checked, frozen=True, kw_only=True, eq=False):
    """Cloud of one turn of a LiDAR as the sensor gives it, with all fields of its points (topic `lidar/points`)."""

    label: ClassVar[str] = "points"

    stamp_ns: StampNs
    #: Counts the clouds of a source.
    scan_id: Count = 0
    #: Name of the sensor, or of its frame.
    sensor: str = ""
    #: x, y and z in metres, float32 or float64, are among them; the LiDAR's frame is REP-103.
    fields: tuple[PointField, ...]
    #: Points in the order of the sensor, row after row, [points, bytes of a point].
    data: Annotated[np.ndarray, Array("|u1", (None, None))]
    #: Rows of an organised cloud (its channels); 1 where the points have no order.
    rows: Annotated[int, msgspec.Meta(ge=1, le=1 << 24)] = 1
    vehicle_from_lidar: Pose2 = Pose2()
    #: Over the ground.
    lidar_height_m: LengthM = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        count, step = self.data.shape
        if count == 0:
            raise ValueError("points.data must hold a point, holds none")
        if self.data.nbytes > MAX_CLOUD_BYTES:
            raise ValueError(f"points.data must have at most {MAX_CLOUD_BYTES} bytes, got {count} points of {step}")
        if count % self.rows:
            raise ValueError(f"points.rows must divide the {count} points, got {self.rows}")
        _require_layout(self.fields, step)

    def __len__(self) -> int:
        return len(self.data)

    def table(self) -> np.ndarray:
        """Return the points as a structured array [points], a view."""
        layout: Any = {"names": [], "formats": [], "offsets": [], "itemsize": self.data.shape[1]}
        for field in self.fields:
            kind = POINT_TYPES[field.datatype]
            layout["names"].append(field.name)
            layout["formats"].append(kind if field.count == 1 else (kind, (field.count,)))
            layout["offsets"].append(field.offset)
        return np.ascontiguousarray(self.data).reshape(-1).view(np.dtype(layout))

    def positions_m(self) -> np.ndarray:
        """Return the positions in the LiDAR's frame [points, 3], float64, of those points that have one."""
        table = self.table()
        positions_m = np.stack([table[name].astype(np.float64) for name in "xyz"], axis=-1)
        positions_m = positions_m[np.isfinite(positions_m).all(axis=1)]
        # what is further than any sensor sees is no position: its square may be no double
        return positions_m[(np.abs(positions_m) <= MAX_POSITION_M).all(axis=1)]


def _require_layout(fields: tuple[PointField, ...], step: int) -> None:
    """Raise `ValueError` unless fields have names of their own, fit into a point, and hold a position."""
    if len(fields) > MAX_POINT_FIELDS:
        raise ValueError(f"points.fields must be at most {MAX_POINT_FIELDS}, got {len(fields)}")
    kinds = {field.name: field.datatype for field in fields}
    if len(kinds) < len(fields):
        raise ValueError(f"points.fields must have different names, got {', '.join(field.name for field in fields)}")
    for field in fields:
        if field.end > step:
            raise ValueError(
                f"points.fields: {field.name!r} must end within the point's {step} bytes, ends at {field.end}"
            )
    for name in "xyz":
        if kinds.get(name) not in ("float32", "float64"):
            instead = f"is {kinds[name]}" if name in kinds else f"there are {', '.join(kinds) or 'none'}"
            raise ValueError(f"points.fields must hold {name} as float32 or float64, {instead}")
