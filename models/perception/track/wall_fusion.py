"""Fusion of wall priors with the walls of a scan: what the radar sees decides where the two differ.

A prior on a measured wall's line corrects and extends it; one that is seen through, or runs beside or across, is no
wall.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from models.perception.track.wall_lines import RADAR, WallLine
from models.physics.mirror import crosses, segments_cross
from msgs.values.perception import Wall

#: Older messages are dropped; a source repeats its walls more often.
MAX_AGE_S = 2.0
#: Errors of odometry over a metre driven since the message.
PLACE_STD_M_PER_M = 0.02
HEADING_STD_RAD_PER_M = math.radians(0.05)
#: Errors that all returns of a scan share, added to those of its walls.
SCAN_OFFSET_STD_M = 0.03
SCAN_ANGLE_STD_RAD = math.radians(0.3)
#: Two walls are one where they differ by less than so many standard deviations plus these margins.
SAME_SIGMAS = 3.0
SAME_ANGLE_RAD = math.radians(2.0)
SAME_OFFSET_M = 0.2
#: And where the gap between them is no wider.
JOIN_GAP_M = 2.0
#: Walls side by side that are nearer, or that cross, contradict each other.
RIVAL_M = 3.0
#: Number of direct returns behind a prior, and how far behind, that prove that it is no wall.
SEEN_THROUGH_POINTS = 3
MIN_DEPTH_M = 1.0
#: Ends of a prior within which returns prove nothing.
TRIM_M = 1.0
#: Unevenness of real walls, added to each return's own error.
FLATNESS_M = 0.08
#: A prior alone is a wall from this length and offset on; measured walls as short as a vehicle contradict nothing.
MIN_LENGTH_M = 2.5
MIN_OFFSET_M = 0.5
VEHICLE_LENGTH_M = 5.5
#: Half the field of view, and the range, in which a prior must be visible.
VIEW_RAD = math.radians(60.0)
MAX_RANGE_M = 110.0
#: Number of priors that a scan takes, the nearest first.
MAX_WALLS = 24


class PlacedPrior(NamedTuple):
    """A prior in the radar frame of a scan, and its source."""

    source: str
    line: WallLine


class ScanReturns(NamedTuple):
    """Direct returns of a scan: points [N, 2] with covariances [N, 2, 2], the measured wall of each (-1: none)."""

    points_m: np.ndarray
    covariance_m2: np.ndarray
    wall: np.ndarray


@dataclass
class _Entry:
    """A wall of the scan's list: measured ones by their numbers, the sources that took part in it."""

    line: WallLine
    wall: Wall | None = None
    members: list[int] = field(default_factory=list)
    sources: set[str] = field(default_factory=set)
    inliers: int = 0
    is_changed: bool = False

    @classmethod
    def of(cls, wall: Wall, number: int) -> _Entry:
        return cls(WallLine.of(wall), wall, [number], inliers=wall.inliers)

    @property
    def curvature_per_m(self) -> float:
        return 0.0 if self.wall is None else self.wall.curvature_per_m


def fused(priors: Sequence[PlacedPrior], returns: ScanReturns, walls: list[Wall]) -> tuple[list[Wall], np.ndarray]:
    """Return the walls of a scan with priors, measured ones first, and the wall of each return [N]."""
    visible = [prior for prior in priors if _is_usable(prior.line)]
    nearest = sorted(visible, key=lambda prior: prior.line.range_m)[:MAX_WALLS]
    if not nearest:
        return walls, returns.wall
    fusion = _Fusion(returns, walls)
    # errors at their middles, then names and ends, so that the order is unique
    for prior in sorted(
        nearest,
        key=lambda prior: (float(np.trace(prior.line.covariance)), prior.source, prior.line.ends_m.ravel().tolist()),
    ):
        fusion.add(prior)
    return fusion.result()


def is_one_wall(line: WallLine, other: WallLine, sigmas: float = SAME_SIGMAS) -> bool:
    """Return whether two stretches are of one wall: no gap, one line within sigmas of both and the margins."""
    if line.gap_m(other) > JOIN_GAP_M:
        return False
    off, covariance = other.seen_at(line)
    if not np.isfinite(off).all():
        return False
    joint = covariance + line.covariance
    at = np.array([1.0, line.common_m(other)])
    offset_gate_m = sigmas * math.sqrt(at @ joint @ at) + SAME_OFFSET_M
    angle_gate_rad = sigmas * math.sqrt(joint[1, 1]) + SAME_ANGLE_RAD
    return abs(float(at @ off)) <= offset_gate_m and abs(float(off[1])) <= angle_gate_rad


def _in_view(line: WallLine) -> np.ndarray:
    """Return the points along a wall that lie in the field of view and range [K, 2]."""
    points_m = line.samples_m
    inside = np.abs(np.arctan2(points_m[:, 1], points_m[:, 0])) <= VIEW_RAD
    return points_m[inside & (np.hypot(points_m[:, 0], points_m[:, 1]) <= MAX_RANGE_M)]


def _is_usable(line: WallLine) -> bool:
    """Return whether a prior can be a wall of the scan: long enough, not through the radar, in view."""
    is_wall = 2.0 * line.half_m >= MIN_LENGTH_M and abs(line.offset_m) >= MIN_OFFSET_M
    return is_wall and len(_in_view(line)) > 0


class _Fusion:
    """The list of walls of one scan while priors are added."""

    def __init__(self, returns: ScanReturns, walls: list[Wall]) -> None:
        self._returns = returns
        self._entries = [_Entry.of(wall, index) for index, wall in enumerate(walls)]
        self._measured = list(self._entries)

    def add(self, prior: PlacedPrior) -> None:
        """Take in a prior: correct and extend the walls that it agrees with, else add it, else leave it out."""
        same = [entry for entry in self._entries if self._agrees(prior, entry)]
        rivals = (entry for entry in self._entries if not any(entry is item for item in same))
        is_trusted = not any(self._contradicts(prior, entry) for entry in rivals)
        is_trusted = is_trusted and not self._is_seen_through(prior.line, same)
        if is_trusted and same:
            self._join(prior, same)
        elif is_trusted:
            self._entries.append(_Entry(prior.line, sources={prior.source}))
        else:
            for entry in same:
                self._correct(entry, prior)

    def result(self) -> tuple[list[Wall], np.ndarray]:
        """Return the walls, and the wall of each return [N]."""
        entries = [entry for entry in self._entries if entry.members or self._is_visible(entry)]
        number = np.full(len(self._measured) + 1, -1)
        for index, entry in enumerate(entries):
            number[entry.members] = index
        wall_of_point = number[self._returns.wall]
        walls: list[Wall] = []
        for index, entry in enumerate(entries):
            if entry.wall is not None and not entry.is_changed:
                walls.append(entry.wall)
                continue
            on_line = self._on_line(entry.line, wall_of_point)
            wall_of_point[on_line] = index
            walls.append(self._wall(entry, on_line))
        return walls, wall_of_point

    def _agrees(self, prior: PlacedPrior, entry: _Entry) -> bool:
        """Return whether a prior and a straight wall are one within errors; of one source within the margins alone."""
        if entry.curvature_per_m:
            return False
        sigmas = 0.0 if prior.source in entry.sources and not entry.members else SAME_SIGMAS
        return is_one_wall(replace(entry.line, covariance=self._errors_of(entry)), prior.line, sigmas)

    def _errors_of(self, entry: _Entry) -> np.ndarray:
        """Return the covariance of a wall; that of a measured one with the errors that its returns share."""
        shared = np.square([SCAN_OFFSET_STD_M, SCAN_ANGLE_STD_RAD])
        return entry.line.covariance + (np.diag(shared) if entry.members and not entry.sources else 0.0)

    def _contradicts(self, prior: PlacedPrior, entry: _Entry) -> bool:
        """Return whether a wall denies a prior: it crosses it, or runs beside it; a source never denies itself."""
        is_short = entry.members and 2.0 * entry.line.half_m <= VEHICLE_LENGTH_M
        if is_short or (prior.source in entry.sources and not entry.members):
            return False
        # across: both cross well within their ends
        ends_m = prior.line.trimmed_m(TRIM_M), entry.line.trimmed_m(TRIM_M)
        is_across = bool(segments_cross(*np.concatenate(ends_m).ravel().tolist(), 0.0))
        return is_across or self._is_beside(prior.line, entry)

    def _is_beside(self, line: WallLine, entry: _Entry) -> bool:
        """Return whether a line runs along a wall, or its arc, at less than `rival_m`, over half of the shorter one."""
        ends_m = line.ends_m
        along_m = np.sort(entry.line.along_m(ends_m))
        low_m, high_m = np.clip(along_m, -entry.line.half_m, entry.line.half_m)
        if high_m - low_m < min(line.half_m, entry.line.half_m):
            return False
        height_m = entry.line.height_m(line.samples_m)
        over_m = entry.line.along_m(line.samples_m)
        # an arc lies this far over its chord
        height_m = height_m - 0.5 * entry.curvature_per_m * (over_m**2 - entry.line.half_m**2)
        inside = (over_m >= low_m) & (over_m <= high_m)
        return bool((np.abs(height_m[inside]) < RIVAL_M).all()) if inside.any() else False

    def _is_seen_through(self, line: WallLine, same: list[_Entry]) -> bool:
        """Return whether direct returns in plain sight lie behind parts of a prior that no wall of the scan covers."""
        points_m = self._returns.points_m
        height_m = line.height_m(points_m)
        depth_m = MIN_DEPTH_M + SAME_SIGMAS * math.sqrt(line.covariance[0, 0])
        points_m = points_m[height_m < -depth_m] if line.offset_m > 0.0 else points_m[:0]
        points_m = points_m[~self._behind_measured(points_m)]
        if len(points_m) == 0:
            return False
        share = line.offset_m / (line.offset_m - line.height_m(points_m))
        at_m = line.along_m(points_m * share[:, None])
        margin_m = min(TRIM_M + 2.0 * line.end_std_m, 0.5 * line.half_m)
        through = np.abs(at_m) < line.half_m - margin_m
        for entry in same:
            low_m, high_m = np.sort(line.along_m(entry.line.ends_m))
            through &= (at_m < low_m) | (at_m > high_m)
        return bool(through.sum() >= SEEN_THROUGH_POINTS)

    def _behind_measured(self, points_m: np.ndarray) -> np.ndarray:
        """Return which points [N, 2] lie behind a measured wall: no direct sight leads there; bool [N]."""
        hidden = np.zeros(len(points_m), bool)
        for entry in self._measured:
            if 2.0 * entry.line.half_m > VEHICLE_LENGTH_M:
                hidden |= self._is_behind(entry.line, points_m)
        return hidden

    def _is_behind(self, line: WallLine, points_m: np.ndarray) -> np.ndarray:
        """Return which points [N, 2] the certain part of a wall hides from the radar; bool [N]."""
        low_m, high_m = line.trimmed_m(TRIM_M)
        deep = line.height_m(points_m) < -MIN_DEPTH_M
        return np.asarray(deep & crosses(RADAR, points_m, low_m[None], high_m[None])[:, 0])

    def _join(self, prior: PlacedPrior, same: list[_Entry]) -> None:
        """Make one wall of a prior and all walls that it agrees with."""
        first, *rest = same
        self._correct(first, prior)
        for entry in rest:
            first.members += entry.members
            first.sources |= entry.sources
            first.inliers += entry.inliers
        points_m = np.concatenate([prior.line.ends_m, *(entry.line.ends_m for entry in same)])
        first.line = first.line.reaching(points_m)
        self._entries = [entry for entry in self._entries if not any(entry is item for item in rest)]

    def _correct(self, entry: _Entry, prior: PlacedPrior) -> None:
        """Correct a wall by a prior; each source counts once."""
        entry.is_changed = True
        if prior.source in entry.sources:
            return
        off, noise = prior.line.seen_at(entry.line)
        line = replace(entry.line, covariance=self._errors_of(entry))
        entry.line = line.corrected(np.eye(2), off, noise)
        entry.sources.add(prior.source)

    def _is_visible(self, entry: _Entry) -> bool:
        """Return whether any part of a prior in view lies before all other walls."""
        points_m = _in_view(entry.line)
        hidden = np.zeros(len(points_m), bool)
        for other in self._entries:
            if other is not entry and 2.0 * other.line.half_m > VEHICLE_LENGTH_M:
                hidden |= self._is_behind(other.line, points_m)
        return not hidden.all()

    def _on_line(self, line: WallLine, wall_of_point: np.ndarray) -> np.ndarray:
        """Return the returns of no wall that lie on one, within the errors of both; indices [K]."""
        points_m = self._returns.points_m
        own = np.einsum("i,nij,j->n", line.normal, self._returns.covariance_m2, line.normal)
        along_m = line.along_m(points_m)
        variance = own + line.variance_at(along_m) + FLATNESS_M**2
        near = line.height_m(points_m) ** 2 <= SAME_SIGMAS**2 * variance
        inside = np.abs(along_m) <= line.half_m + TRIM_M
        return np.flatnonzero(near & inside & (wall_of_point == -1))

    def _wall(self, entry: _Entry, on_line: np.ndarray) -> Wall:
        """Return an entry as a wall; a prior without measured walls is corrected by the returns that lie on it."""
        line = entry.line
        if len(on_line) and not entry.members:
            points_m, covariance_m2 = self._returns.points_m[on_line], self._returns.covariance_m2[on_line]
            noise = np.einsum("i,nij,j->n", line.normal, covariance_m2, line.normal) + FLATNESS_M**2
            factors = np.stack([np.ones(len(points_m)), line.along_m(points_m)], axis=1)
            line = line.corrected(factors, -line.height_m(points_m), np.diag(noise))
        return line.as_wall(entry.inliers + len(on_line))
