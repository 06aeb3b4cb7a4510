"""Perception values: peaks, walls, hidden objects, and the truth they are compared with."""

from __future__ import annotations

import math
from enum import IntEnum

import msgspec
import numpy as np

from msgs.values.arrays import require_array, require_finite, require_positive, require_stamps, require_within
from msgs.values.frames import Pose2
from msgs.values.vehicle import VehicleState

#: One object's covariance, row-major 2x2 [m^2].
Covariance = tuple[tuple[float, float], tuple[float, float]]


#: Flag of a view whose networks were trained for another radar: other beams, another array or carrier.
UNTRAINED_SETUP = "untrained_setup"


class PathClass(IntEnum):
    """Kind of a return: direct, or a mirror image behind a wall."""

    LOS = 0
    MIRRORED = 1


#: Limits of the numbers of a peak, in both directions. Far beyond any sensor; within them every derived quantity is a
#: finite double.
PEAK_LIMITS: dict[str, float] = {
    "range_m": 1e6,
    "azimuth_rad": 1e3,
    "score": 1e15,
    "snr_db": 1e4,
    "covariance": 1e12,
}

#: Maximum number of peaks of a scan: no scene has more, and each is compared with each.
MAX_PEAKS = 2048


#: Fields of peaks with one entry a peak.
PEAK_COLUMNS = ("range_m", "azimuth_rad", "score", "path_class", "covariance", "peak_stamp_ns", "snr_db",
                "radial_speed_mps", "radial_speed_std_mps")  # fmt: skip


class SensorLimits(msgspec.Struct, frozen=True, kw_only=True):
    """How finely, how wide and how far a sensor resolves: what the stages after it must know of it."""

    #: Two-way 3 dB width: detections nearer in azimuth are hardly resolved.
    beam_width_rad: float
    azimuth_limit_rad: float
    max_range_m: float
    #: Weaker by more than this at the same range: a side lobe.
    lobe_db: float
    #: SNR of the weakest detection.
    threshold_db: float

    def __post_init__(self) -> None:
        for name in ("beam_width_rad", "azimuth_limit_rad", "max_range_m", "lobe_db"):
            require_positive(f"limits.{name}", getattr(self, name))
        require_finite("limits.threshold_db", self.threshold_db)


class Peaks(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Classified local maxima of one scan (topic `perception/peaks`), N of them."""

    stamp_ns: int
    scan_id: int
    range_m: np.ndarray
    azimuth_rad: np.ndarray
    score: np.ndarray
    #: `PathClass` values, uint8.
    path_class: np.ndarray
    #: Polar covariance (range [m], azimuth [rad]), float64 [N, 2, 2].
    covariance: np.ndarray
    #: Acquisition time of each peak's azimuth, int64 [N].
    peak_stamp_ns: np.ndarray
    #: Peak power over the map's noise, dB.
    snr_db: np.ndarray
    #: Flags of the map that the peaks were found in, and `UNTRAINED_SETUP`.
    incoherent: bool = False
    missing_beams: tuple[int, ...] = ()
    saturated_share: float = 0.0
    faults: tuple[str, ...] = ()
    #: Beam power over noise of an isotropic 0 dBsm target at 1 m, dB: the observability mask needs it.
    sensitivity_db: float = 0.0
    #: Checksum of the network that found them and its method of placing them, "SHA256/WAY"; empty without a network.
    detector: str = ""
    #: Pose of the radar on the vehicle with which the map was formed.
    vehicle_from_radar: Pose2 = Pose2()
    #: Radial speed of each peak, positive away from the radar, over ground where ego motion was compensated, and its
    #: standard deviation, float64 [N]; NaN: not measured. None: of none.
    radial_speed_mps: np.ndarray | None = None
    radial_speed_std_mps: np.ndarray | None = None
    #: Of a sensor that states its own limits; None: those of the parameters hold.
    sensor: SensorLimits | None = None
    #: As the map has it.
    settled_stamp_ns: int | None = None
    #: As the map has it. If False, each peak lies where the radar saw it at `peak_stamp_ns`, not at `stamp_ns`.
    ego_compensated: bool = True

    def __post_init__(self) -> None:
        count = len(self.range_m) if isinstance(self.range_m, np.ndarray) and self.range_m.ndim == 1 else None
        for name in ("range_m", "azimuth_rad", "score", "snr_db"):
            require_array(f"peaks.{name}", getattr(self, name), "<f8", (count,))
        for name in ("radial_speed_mps", "radial_speed_std_mps"):
            if getattr(self, name) is not None:
                require_array(f"peaks.{name}", getattr(self, name), "<f8", (count,))
        require_array("peaks.path_class", self.path_class, "|u1", (count,))
        require_array("peaks.covariance", self.covariance, "<f8", (count, 2, 2))
        require_array("peaks.peak_stamp_ns", self.peak_stamp_ns, "<i8", (count,))
        require_within("peaks.saturated_share", 0.0, 1.0, self.saturated_share)
        require_stamps("peaks.stamp_ns", self.stamp_ns)
        require_stamps("peaks.peak_stamp_ns", self.peak_stamp_ns)
        for name, maximum in PEAK_LIMITS.items():
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"peaks.{name} must be finite")
            require_within(f"peaks.{name}", -maximum, maximum, float(np.abs(getattr(self, name)).max(initial=0.0)))
        require_within("peaks.sensitivity_db", -PEAK_LIMITS["snr_db"], PEAK_LIMITS["snr_db"], self.sensitivity_db)

    def __len__(self) -> int:
        return len(self.range_m)

    def take(self, index: np.ndarray) -> Peaks:
        """Return the peaks at indices, or those that a mask bool [N] keeps."""
        columns = {name: getattr(self, name) for name in PEAK_COLUMNS}
        return msgspec.structs.replace(
            self, **{name: column[index] for name, column in columns.items() if column is not None}
        )


class Wall(msgspec.Struct, frozen=True, kw_only=True):
    """A wall segment, or an arc over it: n.x + offset_m = 0 on the chord with n towards the radar; radar frame."""

    normal: tuple[float, float]
    offset_m: float
    ends_m: tuple[tuple[float, float], tuple[float, float]]
    inliers: int
    #: Standard deviation of the fitted direction and of the offset at the segment's middle.
    angle_std_rad: float = 0.0
    offset_std_m: float = 0.0
    #: Curvature of an arc through the ends, positive if it is hollow towards the radar.
    curvature_per_m: float = 0.0

    def __post_init__(self) -> None:
        require_finite("wall", *self.normal, self.offset_m, *self.ends_m[0], *self.ends_m[1], self.curvature_per_m)
        if abs(math.hypot(*self.normal) - 1.0) > 1e-6:
            raise ValueError(f"wall.normal must have length 1, got {self.normal}")


class HiddenPoint(msgspec.Struct, frozen=True, kw_only=True):
    """One mirrored return folded back through its wall."""

    x_m: float
    y_m: float
    score: float
    #: Its apparent position behind the wall.
    image_x_m: float
    image_y_m: float
    #: Index into `BevFrame.walls`.
    wall: int


class RadialSpeed(msgspec.Struct, frozen=True, kw_only=True):
    """The part of a velocity over ground that Doppler shows: along one direction, in the plane of the radar."""

    #: Direction away from the radar by way of the mirrors, at the object.
    azimuth_rad: float
    speed_mps: float
    std_mps: float


class HiddenObject(msgspec.Struct, frozen=True, kw_only=True):
    """A recovered object: oriented box, score, covariance of its centre."""

    id: int
    x_m: float
    y_m: float
    length_m: float
    width_m: float
    yaw_rad: float
    score: float
    cov_m2: Covariance
    #: Acquisition time of the beams that saw it (a moving object was there then).
    stamp_ns: int = 0
    points: int = 0
    #: pedestrian, bicycle, car, van, truck or bus; empty: nobody judged it.
    object_class: str = ""
    #: None: not measured.
    radial_speed: RadialSpeed | None = None


class Track(msgspec.Struct, frozen=True, kw_only=True):
    """An object followed over scans: its position at the frame's stamp, in its axes; its velocity over ground."""

    id: int
    x_m: float
    y_m: float
    velocity_x_mps: float
    velocity_y_mps: float
    age_s: float
    cov_m2: Covariance
    #: Time until it enters direct sight, None if it is not approaching it.
    time_to_appear_s: float | None = None
    #: Covariance of the velocity, None if the writer of a recording did not give it.
    velocity_cov_m2ps2: Covariance | None = None
    #: Scans since an object was last assigned to it.
    misses: int = 0
    #: Probability that it is an object, 0 to 1; None if the writer of a recording did not give it.
    existence: float | None = None
    #: Likeliest class of its objects, as of `HiddenObject`; empty: nobody judged it.
    object_class: str = ""


class BevGrid(msgspec.Struct, frozen=True, kw_only=True):
    """Square cells of the plane: rows run along y, columns along x, both from their minimum."""

    x_min_m: float = 0.0
    y_min_m: float = -40.0
    cell_m: float = 0.5
    rows: int = 160
    columns: int = 120

    def __post_init__(self) -> None:
        require_positive("bev_grid.cell_m", self.cell_m)
        require_finite("bev_grid", self.x_min_m, self.y_min_m)
        for name in ("rows", "columns"):
            if not 1 <= getattr(self, name) <= 4096:
                raise ValueError(f"bev_grid.{name} must be 1..4096, got {getattr(self, name)!r}")

    def cell_centres_m(self) -> np.ndarray:
        """Return centres of all cells, [rows, columns, 2] in metres."""
        x = self.x_min_m + self.cell_m * (np.arange(self.columns) + 0.5)
        y = self.y_min_m + self.cell_m * (np.arange(self.rows) + 0.5)
        return np.stack(np.meshgrid(x, y), axis=-1)


class Visibility(IntEnum):
    """State of knowledge of a cell of the plane."""

    UNKNOWN = 0
    DIRECT = 1
    #: An object of the stated RCS would have been detected through today's walls.
    MIRRORED = 2


class BevFrame(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Bird's-eye view of one scan (topic `perception/hidden_objects`), radar frame at `stamp_ns`."""

    stamp_ns: int
    scan_id: int
    walls: tuple[Wall, ...] = ()
    points: tuple[HiddenPoint, ...] = ()
    objects: tuple[HiddenObject, ...] = ()
    tracks: tuple[Track, ...] = ()
    #: Direct returns, float32 [N, 2] in metres.
    los_points_m: np.ndarray
    grid: BevGrid = BevGrid()
    #: `Visibility` of each cell, uint8 [rows, columns].
    visibility: np.ndarray
    #: RCS that the mask refers to.
    visibility_rcs_dbsm: float = 10.0
    #: Motion of the vehicle when the scan began, None without a recent state.
    ego: VehicleState | None = None
    #: Of views that share beams with those before: objects measured after the `settled_stamp_ns` of the last view and
    #: up to this are new; None: all are.
    settled_stamp_ns: int | None = None
    #: Conditions of this scan for a reader: "incoherent", "missing_beams", "saturated", "untrained_setup" (of the
    #: networks), and the names in `msgs.values.radar.MAP_FAULTS`.
    flags: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require_stamps("bev.stamp_ns", self.stamp_ns, *(item.stamp_ns for item in self.objects))
        require_array("bev.los_points_m", self.los_points_m, "<f4", (None, 2))
        require_array("bev.visibility", self.visibility, "|u1", (self.grid.rows, self.grid.columns))


class TruthObject(msgspec.Struct, frozen=True, kw_only=True):
    """A simulated object at the truth's stamp, with its velocity so that its position at any other time follows."""

    id: int
    object_class: str
    x_m: float
    y_m: float
    length_m: float
    width_m: float
    yaw_rad: float
    velocity_x_mps: float = 0.0
    velocity_y_mps: float = 0.0
    #: Out of direct sight, and visible in a mirror.
    hidden: bool = False


class TruthSurface(msgspec.Struct, frozen=True, kw_only=True):
    """A simulated surface as a polyline in metres."""

    role: str
    material: str
    polyline_m: tuple[tuple[float, float], ...]


class SceneTruth(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """Ground truth of a scene (topic `sim/truth`), radar frame at `stamp_ns`; points float32 [N, 3] in metres."""

    stamp_ns: int
    scan_id: int
    los_points_m: np.ndarray
    #: Mirror images behind their wall, and in the same order their true positions.
    mirrored_points_m: np.ndarray
    hidden_points_m: np.ndarray
    #: Index into `objects` of each mirrored point, int32; -1 for none.
    hidden_object: np.ndarray
    objects: tuple[TruthObject, ...] = ()
    surfaces: tuple[TruthSurface, ...] = ()

    def __post_init__(self) -> None:
        require_stamps("truth.stamp_ns", self.stamp_ns)
        require_array("truth.los_points_m", self.los_points_m, "<f4", (None, 3))
        require_array("truth.mirrored_points_m", self.mirrored_points_m, "<f4", (None, 3))
        count = len(self.mirrored_points_m)
        require_array("truth.hidden_points_m", self.hidden_points_m, "<f4", (count, 3))
        require_array("truth.hidden_object", self.hidden_object, "<i4", (count,))
