"""Paths of a moving scene between the instants at which it is traced: a beam's signal costs less than a trace.

A path there at two instants is carried: its length by the cubic through both lengths and rates, the rest in straight
lines. Others are faded in or out, as waves over a Fresnel zone, less than which the scene moves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sim_player.scene.world import World
from sim_player.trace.path_table import Paths

#: Ends of one path may lie so far from where its rates carry it; beyond, it is taken for another.
LARGEST_JUMP_M = 0.1
#: How far a scene may move from one instant to the next: radius of the first Fresnel zone half-way between two points
#: 12 m apart at 10 GHz.
LONGEST_MOVE_M = 0.3
#: Columns that go in straight lines, and angles, which go by the shorter way round.
_LINES = "elevation_rad", "departure_elevation_rad", "amplitude", "point_m", "virtual_m"
_TURNS = "azimuth_rad", "departure_azimuth_rad"


def tracing_step_s(world: World, own_speed_mps: float, longest_s: float) -> float:
    """Return the time between two tracings, `longest_s` at most: a radar moves `LONGEST_MOVE_M` at most."""
    speeds = np.append(np.linalg.norm(world.velocity_mps, axis=1), 0.0)
    return float(min(longest_s, LONGEST_MOVE_M / max(own_speed_mps + speeds.max(), 1e-6)))


def scene_step_s(world: World) -> float:
    """Return the same time for a radar that moves as the scene says."""
    return tracing_step_s(world, world.scene.ego.speed_mps, world.radar.scan_period_s)


class PathTrack:
    """Paths of one scene at any time, traced at multiples of `step_s` only; deterministic whatever the order asked."""

    def __init__(self, trace: Callable[[float], Paths], step_s: float) -> None:
        if not step_s > 0.0:
            raise ValueError(f"step_s must be positive, got {step_s!r}")
        self._trace, self._step_s = trace, step_s
        self._knots: dict[int, Paths] = {}
        self._span: tuple[int, Span] | None = None
        self._last: tuple[float, Paths] | None = None

    def at(self, time_s: float) -> Paths:
        """Return all paths at a time; those of the last time are kept."""
        if self._last is None or self._last[0] != time_s:
            self._last = time_s, self._at(time_s)
        return self._last[1]

    def _at(self, time_s: float) -> Paths:
        index = int(np.floor(time_s / self._step_s))
        if self._span is None or self._span[0] != index:
            self._knots = {knot: self._knot(knot) for knot in (index, index + 1)}
            self._span = index, Span(self._knots[index], self._knots[index + 1], self._step_s)
        return self._span[1].at(time_s - index * self._step_s)

    def _knot(self, index: int) -> Paths:
        return self._knots[index] if index in self._knots else self._trace(index * self._step_s)


class Span:
    """Paths between two instants."""

    def __init__(self, first: Paths, last: Paths, step_s: float) -> None:
        here, there = _in_both(first.chain, last.chain)
        carried_m = step_s * (first.radial_speed_mps[here] + last.radial_speed_mps[there])
        stays = np.abs(last.length_m[there] - first.length_m[here] - carried_m) <= LARGEST_JUMP_M
        self._step_s = step_s
        self._first, self._last = first.take(here[stays]), last.take(there[stays])
        self._rise = {name: getattr(self._last, name) - getattr(self._first, name) for name in (*_LINES, *_TURNS)}
        self._rise |= {name: (self._rise[name] + np.pi) % (2.0 * np.pi) - np.pi for name in _TURNS}
        self._goes, self._comes = (
            first.take(_all_but(len(first), here[stays])),
            last.take(_all_but(len(last), there[stays])),
        )

    def at(self, since_s: float) -> Paths:
        """Return all paths so long after the first instant."""
        share = since_s / self._step_s
        goes, comes = _faded(self._goes, 1.0 - share, since_s), _faded(self._comes, share, since_s - self._step_s)
        return Paths.joined([self._carried(since_s), goes, comes])

    def _carried(self, since_s: float) -> Paths:
        first, last, share = self._first, self._last, since_s / self._step_s
        length_m, rate_mps = _cubic(
            (first.length_m, last.length_m),
            (2.0 * first.radial_speed_mps, 2.0 * last.radial_speed_mps),
            share,
            self._step_s,
        )
        carried = {name: getattr(first, name) + share * rise for name, rise in self._rise.items()}
        return replace(first, length_m=length_m, radial_speed_mps=0.5 * rate_mps, **carried)


def _in_both(first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the numbers that two lists share stand in each, in their order; of equal ones the first."""
    (numbers, here), (carried, there) = (np.unique(chain, return_index=True) for chain in (first, last))
    at = np.searchsorted(carried, numbers)
    shared = at < len(carried)
    shared[shared] = carried[at[shared]] == numbers[shared]
    return here[shared], there[at[shared]]


def _all_but(count: int, rows: np.ndarray) -> np.ndarray:
    """Return all of so many rows but some, as a mask."""
    mask = np.ones(count, bool)
    mask[rows] = False
    return mask


def _faded(paths: Paths, share: float, elapsed_s: float) -> Paths:
    """Return paths carried on at their own rate, with a share of their field."""
    if not len(paths):
        return paths
    length_m = paths.length_m + 2.0 * elapsed_s * paths.radial_speed_mps
    return replace(paths, length_m=length_m, amplitude=share * paths.amplitude)


def _cubic(
    value: tuple[np.ndarray, np.ndarray], rate: tuple[np.ndarray, np.ndarray], share: float, step_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the cubic through two values with two rates of change, and its rate, at a share of the step (Hermite)."""
    rise = value[1] - value[0]
    start, end = rate[0] * step_s - rise, rate[1] * step_s - rise
    left = 1.0 - share
    at = value[0] + share * rise + share * left * (left * start - share * end)
    slope = rise + (left - share) * (left * start - share * end) - share * left * (start + end)
    return at, slope / step_s
