"""A scene seen by a single-photon LiDAR: level rays at the sensor's height, optical paths, photon histograms.

A ray's first surface scatters light straight back; a wall's smooth face sends the rest on, over up to `MIRRORS` walls;
and from its spot on a wall light reaches hidden objects in patches and returns: Eq. (8). Left out: light through panes,
the glint of a wall seen head-on, matt returns of hidden walls, three bounces after a mirror.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property

import msgspec
import numpy as np

from models.physics.curved_mirror import arc_from_ends
from models.physics.mirror import CLEARANCE_M, crossing_parameters
from models.physics.photons.counting import draw_histogram, exact_draw
from models.physics.photons.optics import confocal_photons, direct_photons
from msgs.values.array_table import ArrayTable
from msgs.values.lidar import LidarSetup, SpadParams
from msgs.values.perception import PathClass
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.lidar.optical_surfaces import PATCH_M, Patches, Surfaces, all_surfaces, patches_of
from sim_player.scene.segments import ARC_CLEARANCE_M, VOLUME, WALL, Blockers, free_segments
from sim_player.scene.world import Snapshot, World, snapshot

#: Largest number of mirrors on a ray.
MIRRORS = 2
#: Largest number of rays times surfaces, or spots times patches, in memory at a time.
MAX_PAIRS = 1 << 18
#: Detections over a whole scan below which a contribution is left out.
BUDGET = 1e-3


class LightRoute(IntEnum):
    """Route of the light: straight, over mirrors, or scattered by a wall in both directions."""

    DIRECT = 0
    MIRROR = 1
    DIFFUSE = 2


@dataclass(frozen=True)
class OpticalPaths(ArrayTable):
    """P paths of light, each at one azimuth."""

    azimuth_index: np.ndarray
    range_m: np.ndarray
    #: Mean detected signal photons per pulse, Eq. (10).
    photons: np.ndarray
    #: `PathClass` and `LightRoute` values, uint8.
    kind: np.ndarray
    route: np.ndarray
    #: Object it comes from, -1 for a wall; int32.
    object_index: np.ndarray


class OpticPlan(msgspec.Struct, frozen=True, kw_only=True):
    """Decision about one contribution, with its reason."""

    name: str
    used: bool
    #: Upper bound of the detections that it adds, or moves, over all azimuths of a scan.
    bound: float
    reason: str


def optical_paths(
    world: World,
    lidar: LidarSetup,
    time_s: float = 0.0,
    budget: float = BUDGET,
    azimuths: np.ndarray | None = None,
) -> OpticalPaths:
    """Return all paths of light at a time after start, of all azimuths or an index array; ValueError: no finite time.

    Without contributions of at most `budget` detections a scan, and what lies beyond the unambiguous range.
    """
    sight = _Sight.of(world, lidar, time_s, budget, azimuths)
    used = {plan.name for plan in _contributions(sight) if plan.used}
    parts = [sight.direct()]
    if "mirror" in used:
        parts += sight.mirrored()
    if "diffuse" in used:
        parts += sight.confocal()
    return _within(OpticalPaths.joined(parts), lidar.spad)


def plan_optics(world: World, lidar: LidarSetup) -> tuple[OpticPlan, ...]:
    """Return the contributions that a scene needs at its start, each with a bound and a reason."""
    return *_contributions(_Sight.of(world, lidar, 0.0, BUDGET, None)), _carry_over(lidar)


def spad_histograms(lidar: LidarSetup, paths: OpticalPaths, seed: Sequence[int]) -> np.ndarray:
    """Return the photon histograms of all azimuths, uint32 [azimuth, bins], each by its own stream [*seed, azimuth].

    Raises ValueError for paths off the grid, and as `models.physics.photons.counting`.
    """
    histograms = [
        draw_histogram(lidar.spad, _delay_s(group), group.photons, np.random.default_rng([*seed, azimuth]))
        for azimuth, group in enumerate(_measured(lidar, paths))
    ]
    return np.array(histograms).astype(np.uint32)


# -- rays ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Rays(ArrayTable):
    """N level rays, traced so far."""

    azimuth_index: np.ndarray
    origin: np.ndarray
    direction: np.ndarray
    #: So far: path length, two-way share of the mirrors passed, width per radian of divergence and its slope.
    range_m: np.ndarray
    share: np.ndarray
    spread_m: np.ndarray
    slope: np.ndarray


@dataclass(frozen=True)
class _Hits:
    """First hits of N rays: `rays` moved there, piece, level normal towards the ray, cosine of incidence."""

    rays: _Rays
    piece: np.ndarray
    normal: np.ndarray
    cosine: np.ndarray

    def take(self, selection: np.ndarray) -> _Hits:
        """Return the hits of an index or mask."""
        return _Hits(self.rays.take(selection), self.piece[selection], self.normal[selection], self.cosine[selection])


def _first_hits(surfaces: Surfaces, rays: _Rays) -> _Hits:
    """Return the first hit of each ray; rays without one are left out."""
    range_m, piece = _nearest(surfaces, rays.origin, rays.direction)
    met = np.isfinite(range_m)
    rays, range_m, piece = rays.take(met), range_m[met], piece[met]
    point = rays.origin + range_m[:, None] * rays.direction
    normal = _normals(surfaces, piece, point, rays.direction)
    moved = replace(rays, origin=point, range_m=rays.range_m + range_m, spread_m=rays.spread_m + rays.slope * range_m)
    cosine = surfaces.level[piece] * np.abs(np.sum(normal * rays.direction, axis=1))
    return _Hits(moved, piece, normal, np.minimum(cosine, 1.0))


def _nearest(surfaces: Surfaces, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance [N] to the nearest piece (infinite: none) and its index."""
    range_m, piece = np.full(len(origin), np.inf), np.zeros(len(origin), np.int64)
    straight = np.flatnonzero(surfaces.curvature_per_m == 0.0)
    step = max(MAX_PAIRS // max(len(straight), 1), 1)
    a, b = surfaces.a[straight], surfaces.b[straight]
    reach = CLEARANCE_M / np.maximum(np.hypot(*(b - a).T), CLEARANCE_M)
    for start in range(0, len(origin) if len(straight) else 0, step):
        block = slice(start, start + step)
        along, share = crossing_parameters(origin[block], origin[block] + direction[block], a, b)
        # comparisons with NaN (parallel) are false: not met
        met = (along > CLEARANCE_M) & (share >= -reach) & (share <= 1.0 + reach)
        along = np.where(met, along, np.inf)
        range_m[block], piece[block] = along.min(axis=1), straight[along.argmin(axis=1)]
    for index in np.flatnonzero(surfaces.curvature_per_m != 0.0):
        along = _arc_ranges(surfaces.a[index], surfaces.b[index], surfaces.curvature_per_m[index], origin, direction)
        nearer = along < range_m
        range_m[nearer], piece[nearer] = along[nearer], index
    return range_m, piece


def _arc_ranges(
    a: np.ndarray, b: np.ndarray, curvature_per_m: float, origin: np.ndarray, direction: np.ndarray
) -> np.ndarray:
    """Return the distance [N] to one arc, infinite where a ray misses it."""
    centre, radius_m, _, _ = arc_from_ends(a, b, curvature_per_m)
    from_centre = origin - centre
    half = np.sum(from_centre * direction, axis=1)
    root = np.sqrt(np.maximum(half**2 - np.sum(from_centre**2, axis=1) + radius_m**2, 0.0))
    along = -half[:, None] + root[:, None] * np.array([-1.0, 1.0])
    point = origin[:, None] + along[..., None] * direction[:, None]
    # an arc less than a half circle is the part of its circle beyond the chord, seen from the centre
    beyond = np.sum((point - 0.5 * (a + b)) * (0.5 * (a + b) - centre), axis=-1) >= -CLEARANCE_M
    met = (root > 0.0)[:, None] & beyond & (along > ARC_CLEARANCE_M)
    return np.where(met, along, np.inf).min(axis=1)


def _normals(surfaces: Surfaces, piece: np.ndarray, point: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the unit normals [N, 2] of pieces at points, against the rays."""
    along = surfaces.b[piece] - surfaces.a[piece]
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    for index in np.unique(piece[surfaces.curvature_per_m[piece] != 0.0]):
        here = piece == index
        ends = surfaces.a[index], surfaces.b[index], surfaces.curvature_per_m[index]
        normal[here] = point[here] - arc_from_ends(*ends)[0]
    normal /= np.hypot(*normal.T)[:, None]
    return np.where(np.sum(normal * direction, axis=1)[:, None] > 0.0, -normal, normal)


def _reflected(surfaces: Surfaces, hits: _Hits, share: np.ndarray) -> _Rays:
    """Return the rays after a mirror that leaves a share of their power in each direction, unless none is left."""
    rays, level = hits.rays, np.sum(hits.normal * hits.rays.direction, axis=1)
    along = surfaces.b[hits.piece] - surfaces.a[hits.piece]
    left = along[:, 0] * hits.normal[:, 1] - along[:, 1] * hits.normal[:, 0] > 0.0
    # the centre of a positive curvature lies to the left: rays from there are focused
    bulge = np.where(left, -1.0, 1.0) * surfaces.curvature_per_m[hits.piece]
    on = replace(
        rays,
        direction=rays.direction - 2.0 * level[:, None] * hits.normal,
        share=rays.share * np.square(share),
        slope=rays.slope + 2.0 * bulge * rays.spread_m / np.maximum(hits.cosine, 1e-6),
    )
    return on.take(on.share > 0.0)


# -- one instant -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Sight:
    """A world frozen at a time, and the first hits of the laser's rays."""

    view: Snapshot
    lidar: LidarSetup
    budget: float
    surfaces: Surfaces
    first: _Hits
    #: Share of the scan's azimuths in use.
    part: float

    @classmethod
    def of(cls, world: World, lidar: LidarSetup, time_s: float, budget: float, azimuths: np.ndarray | None) -> _Sight:
        """Freeze the world and send the first rays."""
        if not math.isfinite(time_s):
            raise ValueError(f"time_s must be finite, got {time_s!r}")
        index = np.arange(lidar.grid.azimuth_bins) if azimuths is None else np.asarray(azimuths, np.int64)
        view = snapshot(world, time_s)
        surfaces = all_surfaces(view, lidar.lidar_height_m)
        heading = lidar.grid.azimuth_rad[index] + view.pose.yaw_rad
        zero = np.zeros(len(index))
        rays = _Rays(
            azimuth_index=index,
            origin=np.broadcast_to(view.origin, (len(index), 2)),
            direction=np.column_stack([np.cos(heading), np.sin(heading)]),
            range_m=zero,
            share=zero + 1.0,
            spread_m=zero,
            slope=zero + 1.0,
        )
        part = len(index) / lidar.grid.azimuth_bins
        return cls(view, lidar, budget, surfaces, _first_hits(surfaces, rays), part)

    def returns(self, hits: _Hits, route: LightRoute) -> OpticalPaths:
        """Return the light that the surfaces hit scatter straight back along the rays."""
        rays, met = hits.rays, self.surfaces.take(hits.piece)
        spad = self.lidar.spad
        albedo = met.diffuse(hits.cosine, spad.wavelength_m)
        photons = rays.share * direct_photons(spad, rays.range_m, albedo, hits.cosine, rays.spread_m)
        return _optical_paths(rays.azimuth_index, rays.range_m, photons, route, met.object_index)

    def direct(self) -> OpticalPaths:
        """Return the first surface of every azimuth."""
        return self.returns(self.first, LightRoute.DIRECT)

    def mirrored(self) -> list[OpticalPaths]:
        """Return the paths by one mirror and by two."""
        parts, hits = [], self.first
        for _ in range(MIRRORS):
            share = self.surfaces.take(hits.piece).mirror(hits.cosine, self.lidar.spad.wavelength_m)
            hits = _first_hits(self.surfaces, _reflected(self.surfaces, hits, share))
            parts.append(self.returns(hits, LightRoute.MIRROR))
        return parts

    @property
    def spots(self) -> _Hits:
        """Spots of the laser on walls."""
        return self.first.take(self.surfaces.object_index[self.first.piece] < 0)

    @cached_property
    def patches(self) -> Patches:
        """All objects in patches."""
        return patches_of(self.view)

    def confocal(self) -> list[OpticalPaths]:
        """Return the confocal returns of all patches, per azimuth and object in cells of half the timing's width."""
        patches, spots = self.patches, self.spots
        if not len(patches.area_m2) or not len(spots.piece):
            return []
        # for light foliage blocks, and shadows of tops are sharp
        blockers = self.view.blockers
        kind = np.where(blockers.kind == VOLUME, WALL, blockers.kind).astype(np.int8)
        blockers = replace(blockers, kind=kind, wavelength_m=0.0)
        # at least one spot at a time, however many patches there are
        step = max(MAX_PAIRS // len(patches.area_m2), 1)
        parts = np.split(np.arange(len(spots.piece)), range(step, len(spots.piece), step))
        return [self._confocal(spots.take(part), patches, blockers) for part in parts]

    def _confocal(self, spots: _Hits, patches: Patches, blockers: Blockers) -> OpticalPaths:
        spad, height_m = self.lidar.spad, self.lidar.lidar_height_m
        spot = np.column_stack([spots.rays.origin, np.full(len(spots.piece), height_m)])
        to_patch = patches.position_m - spot[:, None]
        spot_range_m = np.linalg.norm(to_patch, axis=-1)
        wall_cosine = np.einsum("nqi,ni->nq", to_patch[..., :2], spots.normal) / spot_range_m
        object_cosine = -np.einsum("nqi,qi->nq", to_patch, patches.normal) / spot_range_m
        n, q = np.nonzero((wall_cosine > 0.0) & (object_cosine > 0.0))
        free = free_segments((spot[n], patches.position_m[q]), blockers, patches.owner[q]).free
        n, q = n[free], q[free]
        wall_albedo = self.surfaces.take(spots.piece).diffuse(spots.cosine, spad.wavelength_m)
        photons = confocal_photons(
            spad,
            spots.rays.range_m[n],
            wall_albedo[n],
            spot_range_m[n, q],
            np.minimum(wall_cosine[n, q], 1.0),
            np.minimum(object_cosine[n, q], 1.0),
            patches.area_m2[q],
            patches.albedo[q],
        )
        range_m = spots.rays.range_m[n] + spot_range_m[n, q]
        return _condensed(spots.rays.azimuth_index[n], range_m, photons, patches.object_index[q], spad)


def _optical_paths(
    azimuth_index: np.ndarray, range_m: np.ndarray, photons: np.ndarray, route: LightRoute, object_index: np.ndarray
) -> OpticalPaths:
    """Return the paths of one route."""
    kind = PathClass.LOS if route == LightRoute.DIRECT else PathClass.MIRRORED
    count = len(range_m)
    return OpticalPaths(
        azimuth_index, range_m, photons, np.full(count, kind, np.uint8), np.full(count, route, np.uint8), object_index
    )


def _condensed(
    azimuth_index: np.ndarray, range_m: np.ndarray, photons: np.ndarray, object_index: np.ndarray, spad: SpadParams
) -> OpticalPaths:
    """Return the diffuse paths, those of one object, azimuth and timing cell merged at their mean range."""
    cell_m = 0.25 * SPEED_OF_LIGHT_MPS * spad.timing_rms_s
    key = np.stack([azimuth_index, object_index, np.floor(range_m / cell_m).astype(np.int64)])
    cells, owner = np.unique(key, axis=1, return_inverse=True)
    owner, count = owner.ravel(), cells.shape[1]
    weight = np.bincount(owner, photons, count)
    lit = weight > 0.0
    mean_m = np.bincount(owner, photons * range_m, count)[lit] / weight[lit]
    return _optical_paths(cells[0, lit], mean_m, weight[lit], LightRoute.DIFFUSE, cells[1, lit].astype(np.int32))


# -- planning and counting -------------------------------------------------------------------------------------------


def _contributions(sight: _Sight) -> tuple[OpticPlan, ...]:
    """Return the bounds of the mirror and diffuse contributions of hidden objects, from the first hits."""
    bounds = {"mirror": _mirror_bound(sight), "diffuse": _diffuse_bound(sight)}
    budget = sight.budget
    return tuple(
        OpticPlan(
            name=name,
            used=bound > sight.part * budget,
            bound=bound,
            reason=f"{bound:.3g} detections a scan at most, budget {budget:g}",
        )
        for name, bound in bounds.items()
    )


def _mirror_bound(sight: _Sight) -> float:
    """Return the detections by mirrors if each mirror showed white surfaces at its own range."""
    met, spad, hits = sight.surfaces.take(sight.first.piece), sight.lidar.spad, sight.first
    share = np.square(met.mirror(hits.cosine, spad.wavelength_m))
    # arcs may focus
    spread_m = 0.0 if sight.surfaces.curvature_per_m.any() else hits.rays.range_m
    photons = share * direct_photons(spad, hits.rays.range_m, 1.0, 1.0, spread_m)
    return MIRRORS * spad.pulses * float(photons.sum())


def _diffuse_bound(sight: _Sight) -> float:
    """Return the detections of confocal returns if each object showed all its faces, head-on, at its nearest point."""
    spots, patches, spad = sight.spots, sight.patches, sight.lidar.spad
    albedo = sight.surfaces.take(spots.piece).diffuse(spots.cosine, spad.wavelength_m)
    total = 0.0
    for index in np.unique(patches.object_index):
        own = patches.object_index == index
        positions = patches.position_m[own, :2]
        middle = positions.mean(axis=0)
        reach_m = PATCH_M + np.hypot(*(positions - middle).T).max()
        to_middle = middle - spots.rays.origin
        spot_range_m = np.maximum(np.hypot(*to_middle.T) - reach_m, CLEARANCE_M)
        before = np.clip((np.sum(to_middle * spots.normal, axis=1) + reach_m) / spot_range_m, 0.0, 1.0)
        area_m2, white = patches.area_m2[own].sum(), patches.albedo[own][0]
        photons = confocal_photons(spad, spots.rays.range_m, albedo, spot_range_m, before, 1.0, area_m2, white)
        total += float(photons.sum())
    return spad.pulses * total


def _carry_over(lidar: LidarSetup) -> OpticPlan:
    """Return the plan of the dead time that reaches into the next period."""
    spad, exact = lidar.spad, exact_draw(lidar.spad)
    bound = 0.0 if exact else float(lidar.grid.azimuth_bins * spad.pulses)
    reason = "periods are independent" if exact else f"arming 'free', dead time {spad.dead_time_s:g} s: in the means"
    return OpticPlan(name="carry_over", used=not exact, bound=bound, reason=reason)


def _measured(lidar: LidarSetup, paths: OpticalPaths) -> list[OpticalPaths]:
    """Return the paths of every azimuth, which meet one ambient light and are counted together."""
    count = lidar.grid.azimuth_bins
    if len(paths) and not 0 <= paths.azimuth_index.min() <= paths.azimuth_index.max() < count:
        raise ValueError(f"azimuth_index must lie in 0..{count - 1}, got {paths.azimuth_index.tolist()!r}")
    order = np.argsort(paths.azimuth_index, kind="stable")
    borders = np.searchsorted(paths.azimuth_index[order], np.arange(1, count))
    return [paths.take(selection) for selection in np.split(order, borders)]


def _within(paths: OpticalPaths, spad: SpadParams) -> OpticalPaths:
    """Return the paths within the unambiguous range that have power."""
    return paths.take((paths.photons > 0.0) & (paths.range_m < spad.unambiguous_range_m))


def _delay_s(paths: OpticalPaths) -> np.ndarray:
    return 2.0 * paths.range_m / SPEED_OF_LIGHT_MPS
