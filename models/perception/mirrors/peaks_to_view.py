"""The geometry stage: from classified peaks to the bird's-eye view of hidden objects."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import msgspec
import numpy as np

from models.perception.mirrors.clustering import dbscan
from models.perception.mirrors.image_walls import DirectReturns, RecoveryParams
from models.perception.mirrors.mirror_table import NO_WALL, nearest_walls, wall_arrays
from models.perception.mirrors.observability import VisibilityParams, observability
from models.perception.mirrors.published import BUDDY, published_structure
from models.perception.mirrors.recovered_objects import ObjectParams, form_objects
from models.perception.mirrors.recovery import (
    Recovered,
    Residual,
    cartesian_covariance,
    corrected,
    recover,
    reflection_state,
)
from models.perception.mirrors.rejection import hidden_mask, in_plain_sight
from models.perception.mirrors.walls import WallParams, find_walls
from models.perception.target_lists.two_witnesses import agreed
from models.perception.target_lists.wall_points import wall_like
from msgs.values.arrays import require_positive
from msgs.values.frames import polar_from_xy, xy_from_polar
from msgs.values.perception import MAX_PEAKS, BevFrame, BevGrid, HiddenObject, PathClass, Peaks, SensorLimits, Wall

#: Returns [N, 2] with covariances [N, 2, 2], the walls among them and the wall of each return (-1: none), int64 [N]
#: -> the last two, extended by walls from elsewhere.
WallPrior = Callable[[np.ndarray, np.ndarray, list[Wall], np.ndarray], tuple[list[Wall], np.ndarray]]
#: Walls of a scan -> the same, corrected and extended by those of a map or another sensor.
WithPriors = Callable[[list[Wall]], list[Wall]]
#: An object in plain sight stays from this score on: returns that hid it may be missed.
SURE_SCORE = 0.7
#: Fitted walls of a scan, and what joins priors to walls -> what waits for its hidden objects, in place of clusters of
#: folded positions; it takes the view's mask and its grid, or neither.
ObjectJudge = Callable[[list[Wall], WithPriors | None], Callable[..., tuple[HiddenObject, ...]]]
#: Walls, association and rejection: ours, or those of the specification (section 3.1.2).
BackEnd = Literal["ours", "specification"]

#: Former parameters of the node, by their place: the modules of the constants that they are.
FORMERLY = {
    "": "models.perception.mirrors.peaks_to_view",
    "walls": "models.perception.mirrors.walls",
    "walls.arcs": "models.perception.mirrors.arcs",
    "wall_points": "models.perception.target_lists.wall_points",
    "recovery": "models.perception.mirrors.image_walls",
    **dict.fromkeys(
        ("recovery.reject_on_wall", "recovery.reject_at_return", "recovery.reject_on_vehicle",
         "recovery.open_view_margin_m", "recovery.comparable_db", "recovery.vehicle_eps_m"),
        "models.perception.mirrors.rejection",
    ),
    "objects": "models.perception.mirrors.recovered_objects",
    "visibility": "models.perception.mirrors.observability",
}  # fmt: skip


class GeometryParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the geometry stage; defaults are the released settings where those exist.

    The back end `specification` uses the clusters and `objects` alone.
    """

    #: Walls, association and rejection: ours, or those of the specification.
    back_end: BackEnd = "ours"
    cluster_eps_m: float = 4.0
    cluster_min_points: int = 2
    walls: WallParams = WallParams()
    #: Walls are of the direct returns that look like part of one by those about them.
    wall_points: bool = False
    recovery: RecoveryParams = RecoveryParams()
    objects: ObjectParams = ObjectParams()
    visibility: VisibilityParams = VisibilityParams()
    grid: BevGrid = BevGrid()

    def __post_init__(self) -> None:
        require_positive("geometry.cluster_eps_m", self.cluster_eps_m)
        require_positive("geometry.cluster_min_points", self.cluster_min_points)


@dataclass(frozen=True)
class FoldedScan:
    """Direct returns, walls and folded positions of a scan; a direct object explains those that are not `hidden`."""

    returns: DirectReturns
    walls: list[Wall]
    recovered: Recovered
    hidden: np.ndarray


def fold_scan(peaks: Peaks, params: GeometryParams, residual: Residual | None = None) -> FoldedScan:
    """Find walls in the peaks and fold the images back, Eqs. (18), (19); `ValueError` as checked."""
    return _folded(peaks, params, *direct_structure(peaks, params), residual)


def _folded(
    peaks: Peaks,
    params: GeometryParams,
    returns: DirectReturns,
    walls: list[Wall],
    residual: Residual | None,
) -> FoldedScan:
    """Fold the images of a scan whose walls are known."""
    of_specification = params.back_end == "specification"
    recovered = recover(peaks, walls, returns, BUDDY if of_specification else params.recovery)
    if residual is not None:
        recovered = corrected(recovered, residual(reflection_state(recovered, walls, returns)))
    if of_specification:
        # it rejects nothing
        return FoldedScan(returns, walls, recovered, np.ones(len(recovered), bool))
    return FoldedScan(returns, walls, recovered, hidden_mask(recovered, walls, returns, params.recovery))


def recover_bev(
    peaks: Peaks,
    params: GeometryParams,
    residual: Residual | None = None,
    wall_prior: WallPrior | None = None,
    judge: ObjectJudge | None = None,
) -> BevFrame:
    """Form hidden points and objects from peaks by folded positions, or objects as `judge` sees them; no tracks."""
    params = heeding(params, peaks.sensor)
    returns, walls = direct_structure(peaks, params)
    if params.back_end == "specification":
        # it knows the walls of its scan alone
        wall_prior = None
    with_priors = partial(joined_by_priors, peaks, returns, wall_prior) if wall_prior else None
    # a network judges in a thread of its own, while the rest of the view is made
    judged = judge(walls, with_priors) if judge else None
    if wall_prior is not None:
        returns, walls = _with_priors(peaks, returns, walls, wall_prior)
    scan = _folded(peaks, params, returns, walls, residual)
    hidden = scan.recovered.take(scan.hidden)
    visibility = observability(scan.walls, peaks.sensitivity_db, params.grid, params.visibility)
    if judged is None or peaks.sensor:
        objects = form_objects(hidden, scan.walls, params.objects)
    if judged is not None:
        objects = agreed(judged(), objects) if peaks.sensor else _hidden(judged(visibility, params.grid), scan)
    return BevFrame(
        stamp_ns=peaks.stamp_ns,
        scan_id=peaks.scan_id,
        walls=tuple(scan.walls),
        points=hidden.as_hidden_points(),
        objects=objects,
        los_points_m=scan.returns.points_m.astype(np.float32),
        grid=params.grid,
        visibility=visibility,
        visibility_rcs_dbsm=params.visibility.rcs_dbsm,
        settled_stamp_ns=peaks.settled_stamp_ns,
        flags=condition_flags(peaks),
    )


def _hidden(objects: tuple[HiddenObject, ...], scan: FoldedScan) -> tuple[HiddenObject, ...]:
    """Return the objects but unsure ones in plain sight, where a direct echo would outdo that of any mirror."""
    places_m = np.array([(item.x_m, item.y_m) for item in objects]).reshape(-1, 2)
    looked_past = in_plain_sight(places_m, scan.walls, scan.returns)
    kept = [item for item, is_past in zip(objects, looked_past, strict=True) if not is_past or item.score >= SURE_SCORE]
    return tuple(msgspec.structs.replace(item, id=number) for number, item in enumerate(kept))


def heeding(params: GeometryParams, sensor: SensorLimits | None) -> GeometryParams:
    """Return the parameters with the limits of the sensor, where it states them, in place of their own."""
    if sensor is None:
        return params
    beam_deg, azimuth_deg = math.degrees(sensor.beam_width_rad), math.degrees(sensor.azimuth_limit_rad)
    objects = msgspec.structs.replace(params.objects, satellite_beam_deg=beam_deg, lobe_db=sensor.lobe_db)
    visibility = msgspec.structs.replace(
        params.visibility,
        threshold_db=sensor.threshold_db,
        max_range_m=sensor.max_range_m,
        azimuth_limit_deg=azimuth_deg,
    )
    return msgspec.structs.replace(params, objects=objects, visibility=visibility)


def direct_structure(peaks: Peaks, params: GeometryParams) -> tuple[DirectReturns, list[Wall]]:
    """Return the direct returns with their clusters, and the walls; `ValueError` for more than `MAX_PEAKS`."""
    if len(peaks) > MAX_PEAKS:
        raise ValueError(f"peaks must be at most {MAX_PEAKS} a scan, got {len(peaks)}")
    if params.back_end == "specification":
        return published_structure(peaks, params.cluster_eps_m, params.cluster_min_points)
    direct = peaks.path_class == PathClass.LOS
    points_m = xy_from_polar(peaks.range_m[direct], peaks.azimuth_rad[direct])
    covariance_m2 = _direct_covariance(peaks)
    speed_mps = None if peaks.radial_speed_mps is None else peaks.radial_speed_mps[direct]
    labels = dbscan(points_m, params.cluster_eps_m, params.cluster_min_points)
    if not params.wall_points:
        walls, wall_of_point = find_walls(points_m, covariance_m2, labels, params.walls)
    else:
        part = wall_like(points_m, covariance_m2, peaks.snr_db[direct], speed_mps)
        walls, wall_of_point = _walls_among(part, points_m, covariance_m2, params)
    return DirectReturns(points_m, peaks.snr_db[direct], labels, wall_of_point, speed_mps), walls


def _direct_covariance(peaks: Peaks) -> np.ndarray:
    """Return the covariances of the positions of direct returns [N, 2, 2], m^2."""
    direct = peaks.path_class == PathClass.LOS
    return cartesian_covariance(peaks.range_m[direct], peaks.azimuth_rad[direct], peaks.covariance[direct])


def _with_priors(
    peaks: Peaks, returns: DirectReturns, walls: list[Wall], wall_prior: WallPrior
) -> tuple[DirectReturns, list[Wall]]:
    """Return direct returns and walls of a scan with walls from elsewhere."""
    walls, wall = wall_prior(returns.points_m, _direct_covariance(peaks), walls, returns.wall)
    return replace(returns, wall=wall), walls


def joined_by_priors(peaks: Peaks, returns: DirectReturns, wall_prior: WallPrior, walls: list[Wall]) -> list[Wall]:
    """Return walls that other means found in a scan with walls from elsewhere."""
    wall = nearest_walls(returns.points_m, wall_arrays(walls))
    return _with_priors(peaks, replace(returns, wall=wall), walls, wall_prior)[1]


def _walls_among(
    part: np.ndarray, points_m: np.ndarray, covariance_m2: np.ndarray, params: GeometryParams
) -> tuple[list[Wall], np.ndarray]:
    """Return the walls among some of the points [N, 2], and the wall of each point (-1: none), int64 [N]."""
    index = np.flatnonzero(part)
    labels = dbscan(points_m[index], params.cluster_eps_m, params.cluster_min_points)
    walls, wall_of_part = find_walls(points_m[index], covariance_m2[index], labels, params.walls)
    wall_of_point = np.full(len(points_m), NO_WALL)
    wall_of_point[index] = wall_of_part
    return walls, wall_of_point


def warm(params: GeometryParams) -> None:
    """Compile or load the stage's kernels, by a synthetic street, and lay out its grid, before the first scan."""
    recover_bev(synthetic_peaks(), GeometryParams())
    if params.wall_points:
        wall_like(np.zeros((1, 2)), np.zeros((1, 2, 2)), np.zeros(1), None)
    observability([], 0.0, params.grid, params.visibility)


def synthetic_peaks() -> Peaks:
    """Return a facade with a kink, a vehicle before it, and two images behind it, one of that vehicle."""
    along = np.linspace(0.0, 10.0, 9)
    facade = np.stack([np.full(9, 20.0), along - 10.0], axis=1)
    oblique = np.stack([20.0 - 0.4 * along, along + 1.0], axis=1)
    vehicle = np.array([[12.0, -12.0], [12.0, -11.0], [11.0, -12.0]])
    images = np.array([[27.0, -9.0], [27.0, -7.0], [28.0, -4.0]])
    points_m = np.concatenate([facade, oblique, vehicle, images])
    range_m, azimuth_rad = polar_from_xy(points_m)
    count = len(points_m)
    mirrored = np.arange(count) >= count - len(images)
    return Peaks(
        stamp_ns=0,
        scan_id=0,
        range_m=range_m,
        azimuth_rad=azimuth_rad,
        score=np.full(count, 0.9),
        path_class=np.where(mirrored, PathClass.MIRRORED, PathClass.LOS).astype(np.uint8),
        covariance=np.tile(np.diag([0.06**2, 0.01**2]), (count, 1, 1)),
        peak_stamp_ns=np.zeros(count, np.int64),
        snr_db=np.full(count, 20.0),
    )


def condition_flags(peaks: Peaks) -> tuple[str, ...]:
    """Return the conditions of the scan that a reader of its view should know."""
    present = {
        "incoherent": peaks.incoherent,
        "missing_beams": bool(peaks.missing_beams),
        "saturated": peaks.saturated_share > 0.0,
    }
    return tuple(name for name, holds in present.items() if holds) + peaks.faults
