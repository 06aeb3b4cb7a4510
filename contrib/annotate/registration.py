"""Registration of LiDAR clouds: FPFH and RANSAC for a first pose, point-to-plane ICP over voxels for the last.

open3d does the search and the least squares; the quality of the pose is judged here. A pose is as good as its
weakest direction: along a corridor all planes let the cloud slide, and neither fitness nor residual shows it. So the
normal matrix of the last step is judged, in metres: rotations count by the motion at the cloud's own radius.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numba
import numpy as np
from msgspec import Meta

#: The system libraries that open3d loads, as Debian and Ubuntu name them.
APT_LINE = "apt-get install libgl1 libegl1 libx11-6 libusb-1.0-0 libudev1 libgomp1"
#: Fewer points than these determine no pose.
MIN_POINTS = 50
#: A neighbourhood is a line if its second extent is below this share (of squares) of the first, a plane if the
#: third is below this share of the second.
LINE_SHARE, PLANE_SHARE = 0.05, 0.3
#: A plane is level if its normal's upright part is above this.
UPRIGHT_LIMIT = 0.7
#: A first pose is level if the cosine between the two frames' z axes is above this.
LEVEL_LIMIT = 0.94
#: Searches of the global registration; the best after a coarse ICP is used.
GLOBAL_TRIES = 6
#: Weight of the share of conflicts against the share of firm points when poses are compared.
CONFLICT_WEIGHT = 20.0
#: Maximum distance of a firm point from its partner's plane.
FIRM_M = 0.05
#: Offsets along the weakest slide at which the search is repeated, unless the hold is better than this.
SLIDES_M, WELL_HELD = (-1.0, -0.5, 0.5, 1.0), 0.05
#: Bins of directions, elevation and azimuth, of a sensor's view; margin in range that makes a conflict.
SIGHT_BINS, SIGHT_MARGIN_M = (90, 180), 0.5
#: Voxels of the ICP, coarse to fine; correspondences reach twice as far. Its most steps.
VOXELS_M, MAX_ITERATIONS = (0.8, 0.4, 0.2), 60
#: Voxel of the features of global registration, and its rounds.
GLOBAL_VOXEL_M, GLOBAL_ROUNDS = 0.8, 100_000


class RegistrationParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Limits of a registration, beyond which it is refused."""

    #: Share of a cloud's points that must find a partner, counted within the possible overlap.
    min_fitness: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.3
    max_rmse_m: Annotated[float, Meta(gt=0.0)] = 0.08
    #: Mean squared share of a unit motion, in the worst direction, that the planes resist.
    min_hold: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.01
    #: Maximum share of points that lie where another viewpoint looked through.
    max_conflict: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.003


@dataclass(frozen=True, eq=False)
class Hold:
    """Firmness with which point-to-plane pairs hold a pose: `least` in 0..1, and the least resisted motion in words."""

    least: float
    weakest: str
    #: The slide in that motion [3], zero if it only turns.
    slide: np.ndarray
    eigenvalues: tuple[float, ...]
    #: Unit motions (slide, turn times radius) of the eigenvalues, a column each [6, 6].
    motions: np.ndarray

    def unknown(self, min_hold: float) -> tuple[str, ...]:
        """Return in words the motions held less than a limit, slides before turns; empty if the pose is known.

        Motions that are all free mix at will: the mixture is chosen that parts slides from turns.
        """
        free = self.motions[:, np.array(self.eigenvalues) < min_hold]
        if not free.size:
            return ()
        _, turns, mixtures = np.linalg.svd(free[3:], full_matrices=True)
        # ascending by the share of the turn; a mixture beyond the singular values does not turn at all
        order = np.argsort(np.concatenate([turns, np.zeros(len(mixtures) - len(turns))]), kind="stable")
        return tuple(_words(motion)[0] for motion in (free @ mixtures[order].T).T)


NOTHING_HELD = Hold(0.0, "finds no partners", np.zeros(3), (), np.zeros((6, 0)))


@dataclass(frozen=True, eq=False)
class PosedCloud:
    """Points [N, 3] in the frame of the sensor that saw them from its origin, and the sensor's pose [4, 4]."""

    points_m: np.ndarray
    target_from_sensor: np.ndarray

    def points_in_target_m(self) -> np.ndarray:
        """Return the points [N, 3] in the common frame."""
        return moved(self.target_from_sensor, self.points_m)


@dataclass(frozen=True, eq=False)
class Registration:
    """A pose [4, 4] from the source into the target's frame, and its quality."""

    target_from_source: np.ndarray
    #: Share of the source's points with a partner, and share within `FIRM_M` of their partner's plane.
    fitness: float
    firm: float
    rmse_m: float
    pairs: int
    hold: Hold
    #: Share of points, of the source or of a placed cloud, that lie where the other looked through; the middle of
    #: those points in the target's frame, and the distance from it within which half of them lie.
    conflict: float
    conflict_at_m: tuple[float, float, float]
    conflict_radius_m: float
    #: Origin of the search: "given" or "global".
    start: str

    @property
    def score(self) -> float:
        """Value by which poses are compared."""
        return self.firm - CONFLICT_WEIGHT * self.conflict

    def fault(self, params: RegistrationParams) -> str | None:
        """Return the first rule that it breaks, with the value; None if it is valid."""
        if not self.fitness >= params.min_fitness:
            return f"overlap must be at least {params.min_fitness:g} (registration.min_fitness), got {self.fitness:.3f}"
        if not self.rmse_m <= params.max_rmse_m:
            return f"rmse must be at most {params.max_rmse_m:g} m (registration.max_rmse_m), got {self.rmse_m:.3f} m"
        if not self.conflict <= params.max_conflict:
            return (
                f"points must not stand where another viewpoint looked through, at most "
                f"{params.max_conflict:g} (registration.max_conflict), got {self.conflict:.3f}, half of them within "
                f"{self.conflict_radius_m:.1f} m of ({', '.join(f'{value:.1f}' for value in self.conflict_at_m)}) m"
            )
        if unknown := self.hold.unknown(params.min_hold):
            return (
                f"pose must be held in all directions, at least {params.min_hold:g} (registration.min_hold), "
                f"got {self.hold.least:.2g}: it {', '.join(unknown)} ({len(unknown)} of 6 motions are unknown)"
            )
        return None


def import_open3d() -> Any:
    """Load the library on first use; ImportError names the package or the line that installs what is missing."""
    try:
        import open3d
    except ModuleNotFoundError:
        raise ImportError("open3d (pip install open3d-cpu)") from None
    except (ImportError, OSError) as error:
        raise ImportError(f"a system library that open3d loads ({error}); {APT_LINE}") from None
    # open3d has its own TBB in the process, too old for numba, which would warn at every parallel kernel
    numba.config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]
    return open3d


def register(
    source_m: np.ndarray, targets: list[PosedCloud], target_from_source: np.ndarray | None, seed: int = 0
) -> Registration:
    """Register a source cloud [N, 3] to posed ones from a first pose [4, 4], or from any pose on level ground (None).

    Points are in the frame of their sensor. The same input gives the same bytes: poses are rounded to 1e-6 (metres,
    radians), as sums over threads differ in their last bits. Raises ValueError if a cloud is no array of finite points
    or has too few planes.
    """
    for name, points_m in (("source", source_m), *(("target", cloud.points_m) for cloud in targets)):
        if points_m.ndim != 2 or points_m.shape[1] != 3 or not np.isfinite(points_m).all():
            raise ValueError(f"{name} must be finite points of shape (N, 3), got {points_m.dtype} {points_m.shape}")
    clouds = _Clouds(source_m, targets)
    if target_from_source is None:
        coarse_m = VOXELS_M[0]
        candidates = [
            _judged(clouds, _icp(clouds, pose, (coarse_m,)), coarse_m, "global") for pose in _global_poses(clouds, seed)
        ]
        target_from_source, start = (
            max(candidates, key=lambda registration: registration.score).target_from_source,
            "global",
        )
    else:
        start = "given"
    pose = _icp(clouds, target_from_source, VOXELS_M)
    result = _judged(clouds, pose, VOXELS_M[-1], start)
    return max([result, *_searched_along_slide(clouds, result)], key=lambda registration: registration.score)


def _searched_along_slide(clouds: _Clouds, first: Registration) -> list[Registration]:
    """Repeat the search at offsets along the least resisted slide, where false minima lie."""
    repeated = []
    for offset_m in SLIDES_M if first.hold.slide.any() and first.hold.least < WELL_HELD else ():
        start_pose = first.target_from_source.copy()
        start_pose[:3, 3] += offset_m * first.hold.slide
        pose = _icp(clouds, start_pose, VOXELS_M[-2:])
        repeated.append(_judged(clouds, pose, VOXELS_M[-1], first.start))
    return repeated


class _Clouds:
    """A source and its targets, thinned once for each voxel."""

    def __init__(self, source_m: np.ndarray, targets: list[PosedCloud]) -> None:
        self.source_m, self.targets = source_m, targets
        self._target_m = np.concatenate([cloud.points_in_target_m() for cloud in targets])
        self._thinned: dict[float, tuple[Any, Any]] = {}

    def planar(self, voxel_m: float) -> tuple[Any, Any]:
        """Return `planar_cloud` of source and target."""
        if voxel_m not in self._thinned:
            self._thinned[voxel_m] = planar_cloud(self.source_m, voxel_m), planar_cloud(self._target_m, voxel_m)
        return self._thinned[voxel_m]


def _icp(clouds: _Clouds, pose: np.ndarray, voxels_m: tuple[float, ...]) -> np.ndarray:
    """Return the point-to-plane ICP from a pose over voxels, coarse to fine."""
    registration = import_open3d().pipelines.registration
    criteria = registration.ICPConvergenceCriteria(1e-7, 1e-7, MAX_ITERATIONS)
    for voxel_m in voxels_m:
        # clouds of different viewpoints share only a part: points without a partner must not pull
        loss = registration.TukeyLoss(0.5 * voxel_m)
        estimation = registration.TransformationEstimationPointToPlane(loss)
        result = registration.registration_icp(*clouds.planar(voxel_m), 2.0 * voxel_m, pose, estimation, criteria)
        pose = rounded_pose(np.asarray(result.transformation))
    return pose


def planar_cloud(points_m: np.ndarray, voxel_m: float) -> Any:
    """Return an open3d cloud of one point a voxel with normals, of the points whose surroundings are a plane.

    Rings of far ground are lines: their normals are random, and random normals would seem to hold every direction.
    """
    o3d = import_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m)).voxel_down_sample(voxel_m)
    if len(cloud.points) >= MIN_POINTS:
        cloud.estimate_covariances(o3d.geometry.KDTreeSearchParamHybrid(radius=3.0 * voxel_m, max_nn=30))
        spread, axes = np.linalg.eigh(np.asarray(cloud.covariances))
        planar = (spread[:, 1] > LINE_SHARE * spread[:, 2]) & (spread[:, 0] < PLANE_SHARE * spread[:, 1])
        cloud.normals = o3d.utility.Vector3dVector(axes[:, :, 0])
        cloud = cloud.select_by_index(np.flatnonzero(planar))
    if len(cloud.points) < MIN_POINTS:
        raise ValueError(f"cloud must hold at least {MIN_POINTS} points on planes, got {len(cloud.points)}")
    return cloud


def _global_poses(clouds: _Clouds, seed: int) -> list[np.ndarray]:
    """Return poses by RANSAC over FPFH features of upright structures: ground looks alike everywhere."""
    o3d = import_open3d()
    o3d.utility.random.seed(seed)
    registration = o3d.pipelines.registration
    source, target = (_upright(cloud) for cloud in clouds.planar(GLOBAL_VOXEL_M))
    search = o3d.geometry.KDTreeSearchParamHybrid(radius=5.0 * GLOBAL_VOXEL_M, max_nn=100)
    features = [registration.compute_fpfh_feature(cloud, search) for cloud in (source, target)]
    checks = [
        registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        registration.CorrespondenceCheckerBasedOnDistance(1.5 * GLOBAL_VOXEL_M),
    ]
    estimation = registration.TransformationEstimationPointToPoint(False)
    criteria = registration.RANSACConvergenceCriteria(GLOBAL_ROUNDS, 0.999)
    transforms = [
        registration.registration_ransac_based_on_feature_matching(
            source, target, *features, False, 1.5 * GLOBAL_VOXEL_M, estimation, 3, checks, criteria
        ).transformation
        for _ in range(GLOBAL_TRIES)
    ]
    poses = [rounded_pose(np.asarray(pose)) for pose in transforms]
    # a box upside down is the same box, a street is not
    return [pose for pose in poses if pose[2, 2] > LEVEL_LIMIT] or poses


def _upright(cloud: Any) -> Any:
    """Return the points of a levelled cloud whose normals are not on a level plane."""
    upright = cloud.select_by_index(np.flatnonzero(np.abs(np.asarray(cloud.normals)[:, 2]) < UPRIGHT_LIMIT))
    if len(upright.points) < MIN_POINTS:
        raise ValueError(f"cloud must hold at least {MIN_POINTS} upright points, got {len(upright.points)}")
    return upright


def _judged(clouds: _Clouds, pose: np.ndarray, voxel_m: float, start: str) -> Registration:
    """Return a pose with its quality: overlap, residual across the planes, hold, conflicts of sight."""
    source, target = clouds.planar(voxel_m)
    evaluate = import_open3d().pipelines.registration.evaluate_registration
    result = evaluate(source, target, 2.0 * voxel_m, pose)
    pairs = np.asarray(result.correspondence_set)
    if len(pairs) < MIN_POINTS:
        fitness = float(result.fitness)
        return Registration(pose, fitness, 0.0, math.inf, len(pairs), NOTHING_HELD, 1.0, (0.0, 0.0, 0.0), 0.0, start)
    points = moved(pose, np.asarray(source.points)[pairs[:, 0]])
    normals = np.asarray(target.normals)[pairs[:, 1]]
    across_m = np.sum((points - np.asarray(target.points)[pairs[:, 1]]) * normals, axis=1)
    return Registration(
        pose, float(result.fitness), float(np.count_nonzero(np.abs(across_m) <= FIRM_M) / len(source.points)),
        float(np.sqrt(np.mean(across_m**2))), len(pairs), plane_hold(points, normals),
        *_conflict(clouds, pose), start,
    )  # fmt: skip


def _conflict(clouds: _Clouds, pose: np.ndarray) -> tuple[float, tuple[float, float, float], float]:
    """Return the share of points in conflict of the worst pair of views in the worse direction, their middle in the
    target's frame and the distance of half of them from it.
    """
    worst, points_m = 0.0, np.zeros((0, 3))
    for other in clouds.targets:
        source_from_other = np.linalg.inv(pose) @ other.target_from_sensor
        of_source = looked_through(moved(np.linalg.inv(source_from_other), clouds.source_m), other.points_m)
        of_other = looked_through(moved(source_from_other, other.points_m), clouds.source_m)
        if of_source.mean() > worst:
            worst, points_m = float(of_source.mean()), moved(pose, clouds.source_m[of_source])
        if of_other.mean() > worst:
            worst, points_m = float(of_other.mean()), other.points_in_target_m()[of_other]
    if not worst:
        return 0.0, (0.0, 0.0, 0.0), 0.0
    middle_m = np.median(points_m, axis=0)
    radius_m = float(np.median(np.linalg.norm(points_m - middle_m, axis=1)))
    return worst, (float(middle_m[0]), float(middle_m[1]), float(middle_m[2])), radius_m


def looked_through(points_m: np.ndarray, seen_m: np.ndarray) -> np.ndarray:
    """Return whether a sensor at the origin that saw [M, 3] looked through points [N, 3]; bool [N].

    It did if all it saw around lies farther. Directions without a seen point do not decide.
    """
    nearest = np.full(SIGHT_BINS, np.inf)
    row, column, range_m = _sight_bins(seen_m)
    np.minimum.at(nearest, (row, column), range_m)
    # a bin beside an edge may hold either side: the nearest of all neighbours is used
    padded = np.pad(np.pad(nearest, ((1, 1), (0, 0)), constant_values=np.inf), ((0, 0), (1, 1)), mode="wrap")
    neighbours = [padded[i : i + SIGHT_BINS[0], j : j + SIGHT_BINS[1]] for i in range(3) for j in range(3)]
    around = np.min(neighbours, axis=0)
    row, column, range_m = _sight_bins(points_m)
    limit_m = np.where(np.isfinite(nearest[row, column]), around[row, column], 0.0)
    return np.asarray(range_m < 0.95 * limit_m - SIGHT_MARGIN_M)


def _sight_bins(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return elevation and azimuth bins [N] and ranges [N] of points seen from the origin."""
    flat_m = np.hypot(points_m[:, 0], points_m[:, 1])
    elevation = np.arctan2(points_m[:, 2], flat_m) / np.pi + 0.5
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0]) / (2.0 * np.pi) + 0.5
    bins = [
        np.minimum((share * count).astype(int), count - 1)
        for share, count in zip((elevation, azimuth), SIGHT_BINS, strict=True)
    ]
    return bins[0], bins[1], np.hypot(flat_m, points_m[:, 2])


def moved(target_from_source: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """Return points [N, 3] through a rigid transform [4, 4]."""
    return np.asarray(points_m @ target_from_source[:3, :3].T + target_from_source[:3, 3])


def plane_hold(points_m: np.ndarray, normals: np.ndarray) -> Hold:
    """Return how firmly planes at points [N, 3] with unit normals [N, 3] hold a rigid body.

    Eigenvalues of mean(j j') with j = (n, (p - centre) x n / radius): the mean squared motion across the planes of a
    unit motion, where a turn counts by the motion at the cloud's rms radius.
    """
    arms = points_m - points_m.mean(axis=0)
    radius_m = max(float(np.sqrt(np.mean(np.sum(arms**2, axis=1)))), 1e-9)
    rows = np.concatenate([normals, np.cross(arms / radius_m, normals)], axis=1)
    values, vectors = np.linalg.eigh(rows.T @ rows / len(rows))
    eigenvalues = tuple(float(max(value, 0.0)) for value in values)
    words, slide = _words(vectors[:, 0])
    return Hold(eigenvalues[0], words, slide, eigenvalues, vectors)


def _words(motion: np.ndarray) -> tuple[str, np.ndarray]:
    """Return a unit motion [6] in words, and its slide's direction [3], zero if it turns more than it slides."""
    slide, turn = motion[:3], motion[3:]
    is_slide = slide @ slide >= turn @ turn
    axis = slide if is_slide else turn
    axis = axis / np.linalg.norm(axis)
    axis = axis * (-1.0 if axis[np.argmax(np.abs(axis))] < 0.0 else 1.0) + 0.0
    words = f"{'slides along' if is_slide else 'turns about'} ({', '.join(f'{value:.2f}' for value in axis)})"
    return words, axis if is_slide else np.zeros(3)


def rounded_pose(pose: np.ndarray) -> np.ndarray:
    """Return a rigid transform [4, 4] rounded to six decimals of its rotation vector and its position."""
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    turned = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    out[:3, :3] = Rotation.from_rotvec(np.round(turned, 6)).as_matrix()
    out[:3, 3] = np.round(pose[:3, 3], 6) + 0.0
    return out
