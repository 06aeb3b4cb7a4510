"""Perception values: peaks, walls, hidden objects, and the truth they are compared with."""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Annotated, ClassVar

import msgspec
import numpy as np
from msgspec import Meta

from msgs.values.arrays import (
    MAX_SPEED_MPS,
    MAX_STAMP_NS,
    AngleRad,
    Array,
    AzimuthRad,
    Checked,
    Count,
    Covariance,
    LengthM,
    LevelDb,
    Metres,
    Seconds,
    Share,
    SpeedMps,
    StampNs,
    StandardDeviation,
)
from msgs.values.frames import Pose2
from msgs.values.vehicle import VehicleState

#: Flag of a view whose networks were trained for another radar: other beams, another array or carrier.
UNTRAINED_SETUP = "untrained_setup"


class PathClass(IntEnum):
    """Kind of a return: direct, or a mirror image behind a wall."""

    LOS = 0
    MIRRORED = 1


#: Maximum number of peaks of a scan: no scene has more, and each is compared with each.
MAX_PEAKS = 2048


#: Fields of peaks with one entry a peak.
PEAK_COLUMNS = ("range_m", "azimuth_rad", "score", "path_class", "covariance", "peak_stamp_ns", "snr_db",
                "radial_speed_mps", "radial_speed_std_mps")  # fmt: skip


class SensorLimits(Checked, frozen=True, kw_only=True):
    """How finely, how wide and how far a sensor resolves: what the stages after it must know of it."""

    label: ClassVar[str] = "limits"

    #: Two-way 3 dB width: detections nearer in azimuth are hardly resolved.
    beam_width_rad: Annotated[float, Meta(gt=0.0, le=2.0 * math.pi)]
    azimuth_limit_rad: Annotated[float, Meta(gt=0.0, le=math.pi)]
    max_range_m: Annotated[float, Meta(gt=0.0, le=1e6)]
    #: Weaker by more than this at the same range: a side lobe.
    lobe_db: Annotated[float, Meta(gt=0.0, le=300.0)]
    #: SNR of the weakest detection.
    threshold_db: LevelDb


class Peaks(Checked, frozen=True, kw_only=True, eq=False):
    """Classified local maxima of one scan (topic `perception/peaks`), N of them."""

    label: ClassVar[str] = "peaks"

    stamp_ns: StampNs
    scan_id: Count
    range_m: Annotated[np.ndarray, Array("<f8", (None,), 0.0, 1e6)]
    azimuth_rad: Annotated[np.ndarray, Array("<f8", ("range_m",), -math.pi, math.pi)]
    score: Annotated[np.ndarray, Array("<f8", ("range_m",), 0.0, 1.0)]
    #: `PathClass` values, uint8.
    path_class: Annotated[np.ndarray, Array("|u1", ("range_m",), PathClass.LOS, PathClass.MIRRORED)]
    #: Polar covariance (range [m], azimuth [rad]), float64 [N, 2, 2].
    covariance: Annotated[np.ndarray, Array("<f8", ("range_m", 2, 2), covariances=True)]
    #: Acquisition time of each peak's azimuth, int64 [N].
    peak_stamp_ns: Annotated[np.ndarray, Array("<i8", ("range_m",), -MAX_STAMP_NS, MAX_STAMP_NS)]
    #: Peak power over the map's noise, dB.
    snr_db: Annotated[np.ndarray, Array("<f8", ("range_m",), -300.0, 300.0)]
    #: Flags of the map that the peaks were found in, and `UNTRAINED_SETUP`.
    incoherent: bool = False
    missing_beams: tuple[Count, ...] = ()
    saturated_share: Share = 0.0
    faults: tuple[str, ...] = ()
    #: Beam power over noise of an isotropic 0 dBsm target at 1 m, dB: the observability mask needs it. Unknown: -1000.
    sensitivity_db: Annotated[float, Meta(ge=-1e4, le=1e4)] = 0.0
    #: Checksum of the network that found them and its method of placing them, "SHA256/WAY"; empty without a network.
    detector: str = ""
    #: Pose of the radar on the vehicle with which the map was formed.
    vehicle_from_radar: Pose2 = Pose2()
    #: Radial speed of each peak, positive away from the radar, over ground where ego motion was compensated, and its
    #: standard deviation, float64 [N]; NaN: not measured. None: of none.
    radial_speed_mps: (
        Annotated[np.ndarray, Array("<f8", ("range_m",), -MAX_SPEED_MPS, MAX_SPEED_MPS, or_nan=True)] | None
    ) = None
    radial_speed_std_mps: Annotated[np.ndarray, Array("<f8", ("range_m",), 0.0, 1e6, or_nan=True)] | None = None
    #: Of a sensor that states its own limits; None: those of the parameters hold.
    sensor: SensorLimits | None = None
    #: As the map has it.
    settled_stamp_ns: StampNs | None = None
    #: As the map has it. If False, each peak lies where the radar saw it at `peak_stamp_ns`, not at `stamp_ns`.
    ego_compensated: bool = True

    def __len__(self) -> int:
        return len(self.range_m)

    def take(self, index: np.ndarray) -> Peaks:
        """Return the peaks at indices, or those that a mask bool [N] keeps."""
        columns = {name: getattr(self, name) for name in PEAK_COLUMNS}
        return msgspec.structs.replace(
            self, **{name: column[index] for name, column in columns.items() if column is not None}
        )


class Wall(Checked, frozen=True, kw_only=True):
    """A wall segment, or an arc over it: n.x + offset_m = 0 on the chord with n towards the radar; radar frame."""

    label: ClassVar[str] = "wall"

    normal: tuple[Metres, Metres]
    offset_m: Metres
    ends_m: tuple[tuple[Metres, Metres], tuple[Metres, Metres]]
    inliers: Count
    #: Standard deviation of the fitted direction and of the offset at the segment's middle.
    angle_std_rad: StandardDeviation = 0.0
    offset_std_m: StandardDeviation = 0.0
    #: Curvature of an arc through the ends, positive if it is hollow towards the radar.
    curvature_per_m: Annotated[float, Meta(ge=-1e3, le=1e3)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(math.hypot(*self.normal) - 1.0) > 1e-6:
            raise ValueError(f"wall.normal must have length 1, got {self.normal}")


class HiddenPoint(Checked, frozen=True, kw_only=True):
    """One mirrored return folded back through its wall."""

    label: ClassVar[str] = "point"

    x_m: Metres
    y_m: Metres
    score: Share
    #: Its apparent position behind the wall.
    image_x_m: Metres
    image_y_m: Metres
    #: Index into `BevFrame.walls`; -1: none.
    wall: Annotated[int, Meta(ge=-1, le=1 << 31)]


class RadialSpeed(Checked, frozen=True, kw_only=True):
    """The part of a velocity over ground that Doppler shows: along one direction, in the plane of the radar."""

    label: ClassVar[str] = "radial_speed"

    #: Direction away from the radar by way of the mirrors, at the object.
    azimuth_rad: AzimuthRad
    speed_mps: SpeedMps
    std_mps: StandardDeviation


class HiddenObject(Checked, frozen=True, kw_only=True):
    """A recovered object: position of what a mirror shows of it, with its covariance; score; oriented box."""

    label: ClassVar[str] = "object"

    id: Count
    x_m: Metres
    y_m: Metres
    length_m: LengthM
    width_m: LengthM
    yaw_rad: AngleRad
    score: Share
    #: Of the position [m^2].
    cov_m2: Covariance
    #: Centre of the box; None: the position.
    centre_m: tuple[Metres, Metres] | None = None
    #: Acquisition time of the beams that saw it (a moving object was there then).
    stamp_ns: StampNs = 0
    points: Count = 0
    #: pedestrian, bicycle, car, van, truck or bus; empty: nobody judged it.
    object_class: str = ""
    #: None: not measured.
    radial_speed: RadialSpeed | None = None

    @property
    def box_centre_m(self) -> tuple[float, float]:
        """Centre of the box."""
        return self.centre_m or (self.x_m, self.y_m)


class Track(Checked, frozen=True, kw_only=True):
    """An object followed over scans: its position at the frame's stamp, in its axes; its velocity over ground."""

    label: ClassVar[str] = "track"

    id: Count
    x_m: Metres
    y_m: Metres
    velocity_x_mps: SpeedMps
    velocity_y_mps: SpeedMps
    age_s: Seconds
    cov_m2: Covariance
    #: Time until it enters direct sight, None if it is not approaching it.
    time_to_appear_s: Seconds | None = None
    #: Covariance of the velocity, None if the writer of a recording did not give it.
    velocity_cov_m2ps2: Covariance | None = None
    #: Scans since an object was last assigned to it.
    misses: Count = 0
    #: Probability that it is an object, 0 to 1; None if the writer of a recording did not give it.
    existence: Share | None = None
    #: Likeliest class of its objects, as of `HiddenObject`; empty: nobody judged it.
    object_class: str = ""


class BevGrid(Checked, frozen=True, kw_only=True):
    """Square cells of the plane: rows run along y, columns along x, both from their minimum."""

    label: ClassVar[str] = "bev_grid"

    x_min_m: Metres = 0.0
    y_min_m: Metres = -40.0
    cell_m: Annotated[float, Meta(gt=0.0, le=1e6)] = 0.5
    rows: Annotated[int, Meta(ge=1, le=4096)] = 160
    columns: Annotated[int, Meta(ge=1, le=4096)] = 120

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


class BevFrame(Checked, frozen=True, kw_only=True, eq=False):
    """Bird's-eye view of one scan (topic `perception/hidden_objects`), radar frame at `stamp_ns`."""

    label: ClassVar[str] = "bev"

    stamp_ns: StampNs
    scan_id: Count
    walls: tuple[Wall, ...] = ()
    points: tuple[HiddenPoint, ...] = ()
    objects: tuple[HiddenObject, ...] = ()
    tracks: tuple[Track, ...] = ()
    #: Direct returns, float32 [N, 2] in metres.
    los_points_m: Annotated[np.ndarray, Array("<f4", (None, 2), -1e6, 1e6)]
    grid: BevGrid = BevGrid()
    #: `Visibility` of each cell, uint8 [rows, columns].
    visibility: Annotated[
        np.ndarray, Array("|u1", ("grid.rows", "grid.columns"), Visibility.UNKNOWN, Visibility.MIRRORED)
    ]
    #: RCS that the mask refers to.
    visibility_rcs_dbsm: LevelDb = 10.0
    #: Motion of the vehicle when the scan began, None without a recent state.
    ego: VehicleState | None = None
    #: Of views that share beams with those before: objects measured after the `settled_stamp_ns` of the last view and
    #: up to this are new; None: all are.
    settled_stamp_ns: StampNs | None = None
    #: Conditions of this scan for a reader: "incoherent", "missing_beams", "saturated", "untrained_setup" (of the
    #: networks), and the names in `msgs.values.radar.MAP_FAULTS`.
    flags: tuple[str, ...] = ()


#: Objects of a scene.
MAX_TRUTH_OBJECTS = 1 << 16


class TruthObject(Checked, frozen=True, kw_only=True):
    """A simulated object at the truth's stamp, with its velocity so that its position at any other time follows."""

    label: ClassVar[str] = "truth_object"

    id: Count
    object_class: str
    x_m: Metres
    y_m: Metres
    length_m: LengthM
    width_m: LengthM
    yaw_rad: AngleRad
    velocity_x_mps: SpeedMps = 0.0
    velocity_y_mps: SpeedMps = 0.0
    #: Out of direct sight, and visible in a mirror.
    hidden: bool = False


class TruthSurface(Checked, frozen=True, kw_only=True):
    """A simulated surface as a polyline in metres."""

    label: ClassVar[str] = "truth_surface"

    role: str
    material: str
    polyline_m: tuple[tuple[Metres, Metres], ...]


class SceneTruth(Checked, frozen=True, kw_only=True, eq=False):
    """Ground truth of a scene (topic `sim/truth`), radar frame at `stamp_ns`; points float32 [N, 3] in metres."""

    label: ClassVar[str] = "truth"

    stamp_ns: StampNs
    scan_id: Count
    los_points_m: Annotated[np.ndarray, Array("<f4", (None, 3), -1e6, 1e6)]
    #: Mirror images behind their wall, and in the same order their true positions.
    mirrored_points_m: Annotated[np.ndarray, Array("<f4", (None, 3), -1e6, 1e6)]
    hidden_points_m: Annotated[np.ndarray, Array("<f4", ("mirrored_points_m", 3), -1e6, 1e6)]
    #: Index into `objects` of each mirrored point, int32; -1 for none.
    hidden_object: Annotated[np.ndarray, Array("<i4", ("mirrored_points_m",), -1, MAX_TRUTH_OBJECTS - 1)]
    objects: tuple[TruthObject, ...] = ()
    surfaces: tuple[TruthSurface, ...] = ()
