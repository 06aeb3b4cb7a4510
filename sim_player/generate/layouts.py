"""Plans of four types of place: positions of walls, traffic and parked vehicles, the hidden side on the left.

The radar at (0, 0) looks along x; users turn and mirror it. A line lists the kinds of wall that suit it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from sim_player.generate.wall_kinds import Line, RelayKind

PlaceKind = Literal["street", "parking_lot", "residential_block", "mixed_intersection"]

#: Kinds of wall along the side of a road, at its end, and on the front of a building.
ROADSIDE: tuple[RelayKind, ...] = (
    "facade",
    "concrete_wall",
    "brick_wall",
    "glass_front",
    "sound_barrier",
    "container",
    "hedge",
    "trees",
    "curved_wall",
    "curved_wall",
)
ACROSS: tuple[RelayKind, ...] = (
    "facade",
    "concrete_wall",
    "brick_wall",
    "glass_front",
    "sound_barrier",
    "container",
    "curved_wall",
    "curved_wall",
    "corner",
    "corner",
    "corner",
)
FRONT: tuple[RelayKind, ...] = ("facade", "facade", "concrete_wall", "brick_wall", "glass_front")
HOUSE: tuple[RelayKind, ...] = ("facade", "facade", "concrete_wall", "brick_wall")
LANE_END: tuple[RelayKind, ...] = (*HOUSE, "curved_wall", "corner", "corner")
GARDEN: tuple[RelayKind, ...] = ("brick_wall", "concrete_wall", "hedge", "hedge", "trees")
#: Heights of walls around gardens, and of houses.
GARDEN_M, HOUSE_M = (1.2, 2.2), (5.0, 9.0)
BAY_WIDTH_M = 2.5


@dataclass(frozen=True)
class Block:
    """The footprint of a building, and which of its sides ("nesw", x east, y north) have a front of their own."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    fronts: str
    kinds: tuple[RelayKind, ...] = FRONT
    height_m: tuple[float, float] = (4.0, 15.0)

    def sides(self) -> dict[str, Line]:
        """Return the four sides, clockwise, each with its front outside."""
        (x0, x1), (y0, y1) = self.x_m, self.y_m
        corners = {"w": (x0, y0), "n": (x0, y1), "e": (x1, y1), "s": (x1, y0)}
        ends = list(corners.values())
        return {
            side: Line(ends[index], ends[(index + 1) % 4], self.kinds, self.height_m)
            for index, side in enumerate(corners)
        }


@dataclass(frozen=True)
class Zone:
    """A rectangle of road or yard; traffic runs along its heading, or anyhow where it has none."""

    x_m: tuple[float, float]
    y_m: tuple[float, float]
    heading_deg: float | None
    #: Turn of the rectangle around its corner (x_m[0], y_m[0]).
    turn_deg: float = 0.0


@dataclass(frozen=True)
class Bay:
    """A place to park: centre, heading, and whether a truck fits."""

    x_m: float
    y_m: float
    heading_deg: float
    large: bool = False


@dataclass(frozen=True)
class Layout:
    """Parts of a place before walls have a material."""

    blocks: tuple[Block, ...]
    lines: tuple[Line, ...]
    zones: tuple[Zone, ...]
    bays: tuple[Bay, ...] = ()
    #: Fewest and most vehicles parked in the bays.
    parked: tuple[int, int] = (0, 0)


def draw_layout(rng: np.random.Generator, kind: PlaceKind) -> Layout:
    """Return a random plan of a type of place."""
    return _LAYOUTS[kind](rng)


def _street(rng: np.random.Generator) -> Layout:
    """Return a street with walls along it, a building whose corner hides a side street, and an end of three kinds."""
    left, right = rng.uniform(3.5, 8.0), rng.uniform(3.5, 8.0)
    corner, mouth, depth = rng.uniform(6.0, 15.0), rng.uniform(6.0, 11.0), rng.uniform(10.0, 18.0)
    far = corner + mouth
    near = Block((rng.uniform(0.5, 2.5), corner), (left, left + depth), "s")
    side = Zone((corner + 1.0, far - 1.0), (left + 1.0, left + 25.0), 90.0)
    road = Zone((5.0, far + 20.0), (1.0 - right, left - 1.0), 0.0)
    kerb = tuple(Bay(x, 1.3 - right, 0.0, large=True) for x in np.arange(rng.uniform(7.0, 12.0), far, 9.0))
    end = ("open", "across", "bend")[rng.integers(3)]
    if end == "across":
        lean = math.tan(rng.uniform(-0.12, 0.12)) * (left + right)
        across = Line((far, -right), (far + lean, left + rng.uniform(10.0, 18.0)), ACROSS, wing_m=0.7 * mouth)
        lines = (*_along(rng, -right, rng.uniform(2.0, 6.0), far - 0.5), across)
        return Layout((near,), lines, (Zone((5.0, far - 1.0), road.y_m, 0.0), side), kerb, (0, 1))
    if end == "bend":
        turn, length = rng.uniform(40.0, 75.0), rng.uniform(12.0, 24.0)
        x, y = corner + rng.uniform(0.0, 8.0), -right
        tip = (x + length * math.cos(math.radians(turn)), y + length * math.sin(math.radians(turn)))
        lines = (*_along(rng, y, rng.uniform(2.0, 5.0), x), Line((x, y), tip, ACROSS, wing_m=4.0))
        foot = (x - math.sin(math.radians(turn)), y + math.cos(math.radians(turn)))
        bent = Zone((foot[0], foot[0] + 32.0), (foot[1], foot[1] + left + right - 2.0), turn, turn)
        return Layout((near,), lines, (Zone((5.0, x), road.y_m, 0.0), bent), kerb[:1], (0, 1))
    next_block = Block((far, far + rng.uniform(12.0, 25.0)), (left, left + rng.uniform(10.0, 18.0)), "sw")
    lines = _along(rng, -right, rng.uniform(2.0, 6.0), far + rng.uniform(5.0, 20.0))
    return Layout((near, next_block), lines, (road, side), kerb, (0, 2))


def _along(rng: np.random.Generator, y: float, start: float, end: float) -> tuple[Line, ...]:
    """Return the right side of a road: one wall, or two with a gap."""
    if end - start < 22.0 or rng.random() < 0.4:
        return (Line((start, y), (end, y), ROADSIDE),)
    middle = rng.uniform(0.4, 0.6) * (start + end)
    return Line((start, y), (middle, y), ROADSIDE), Line((middle + rng.uniform(0.5, 4.0), y), (end, y), ROADSIDE)


def _mixed_intersection(rng: np.random.Generator) -> Layout:
    """Return a crossing with buildings on three or four corners and traffic on all arms."""
    left, right = rng.uniform(4.0, 9.0), rng.uniform(4.0, 9.0)
    near, width = rng.uniform(7.0, 15.0), rng.uniform(8.0, 14.0)
    far = near + width

    deep = rng.uniform(10.0, 20.0, 4)
    blocks = [
        Block((rng.uniform(0.5, 2.0), near), (left, left + deep[0]), "s"),
        Block((far, far + rng.uniform(12.0, 22.0)), (left, left + deep[1]), "sw"),
        Block((rng.uniform(0.5, 2.0), near), (-right - deep[2], -right), "n"),
        Block((far, far + rng.uniform(12.0, 22.0)), (-right - deep[3], -right), "nw"),
    ]
    lines: tuple[Line, ...] = ()
    missing = rng.integers(6)
    if missing in (1, 3):  # a square with a wall at its back instead of a building
        gone = blocks.pop(int(missing))
        back = far + rng.uniform(1.0, 5.0)
        lines = (Line((back, gone.y_m[0]), (back, gone.y_m[1]), ACROSS, wing_m=4.0, room_m=1.0),)
    if missing == 2:
        blocks.pop(2)
        lines = _along(rng, -right - 6.0, 2.0, near)
    zones = (
        Zone((5.0, far + 25.0), (1.0 - right, left - 1.0), 0.0),
        Zone((near + 1.0, far - 1.0), (left, left + 25.0), 90.0),
        Zone((near + 1.0, far - 1.0), (-right - 25.0, -right), 90.0),
    )
    return Layout(tuple(blocks), lines, zones)


def _residential_block(rng: np.random.Generator) -> Layout:
    """Return a narrow street of houses behind garden walls, hedges and drives, up to a lane on the left; half end."""
    left, right = rng.uniform(3.0, 5.0), rng.uniform(3.0, 5.5)
    start = rng.uniform(-6.0, 0.0)
    lane = start + rng.uniform(11.0, 15.0)
    far = lane + rng.uniform(5.0, 8.0)
    ends = rng.random() < 0.5
    stop = far - 0.5 if ends else far + rng.uniform(11.0, 15.0)
    plots = [_plot(rng, start, lane, left, 0.0)]
    parts = (start, stop) if stop - start < 22.0 else (start, start + rng.uniform(0.45, 0.6) * (stop - start), stop)
    plots += [_plot(rng, a, b, -right, rng.uniform(3.5, 5.0)) for a, b in pairwise(parts)]
    if ends:
        end = Line((far, -right), (far, left + rng.uniform(8.0, 15.0)), LANE_END, (2.0, 8.0), wing_m=0.6 * (far - lane))
        lines: tuple[Line, ...] = (end,)
    else:
        plots.append(_plot(rng, far, stop, left, 0.0))
        lines = ()
    zones = (
        Zone((5.0, stop - 0.5 if ends else stop + 8.0), (0.8 - right, left - 0.8), 0.0),
        Zone((lane + 0.8, far - 0.8), (left + 0.5, left + 22.0), 90.0),
        *(drive for *_, drive in plots if drive is not None),
    )
    kerb = tuple(Bay(x, 1.1 - right, 0.0) for x in (rng.uniform(6.0, 9.0), rng.uniform(14.0, 18.0)) if x < far - 3.0)
    fences = tuple(fence for _, fence, _ in plots)
    return Layout(tuple(house for house, *_ in plots), (*fences, *lines), zones, kerb, (0, 2))


def _plot(
    rng: np.random.Generator, start: float, end: float, kerb: float, drive: float
) -> tuple[Block, Line, Zone | None]:
    """Return a house set back from the kerb at y, its fence along the street, and a drive (width in metres)."""
    side = math.copysign(1.0, kerb)
    low, high = sorted((kerb + side * rng.uniform(2.0, 4.0), kerb + side * rng.uniform(11.0, 14.0)))
    stop = end - drive
    house = Block((start + 1.0, stop - 0.5), (low, high), "s" if side > 0.0 else "n", HOUSE, HOUSE_M)
    ends = ((stop, kerb), (start, kerb)) if side > 0.0 else ((start, kerb), (stop, kerb))
    yard = sorted((kerb + side * 0.5, kerb + side * 12.0))
    zone = Zone((stop + 0.2, end - 0.2), (yard[0], yard[1]), 90.0) if drive else None
    return house, Line(*ends, GARDEN, GARDEN_M), zone


def _parking_lot(rng: np.random.Generator) -> Layout:
    """Return the rows of bays along an aisle, walls around, and containers or a kiosk that hide a part of it."""
    back, right, left = rng.uniform(24.0, 38.0), rng.uniform(9.0, 16.0), rng.uniform(14.0, 24.0)
    x = rng.uniform(7.0, 12.0)
    angle, length = rng.uniform(0.9, 2.2), rng.uniform(7.0, 14.0)
    foot = (x, rng.uniform(3.0, 5.0))
    tip = (foot[0] + length * math.cos(angle), foot[1] + length * math.sin(angle))
    if rng.random() < 0.6:
        blocks: tuple[Block, ...] = ()
        screen: tuple[Line, ...] = (Line(foot, tip, ("container",)),)
    else:
        blocks = (Block((x - 1.0, x + rng.uniform(2.0, 5.0)), (foot[1], foot[1] + rng.uniform(5.0, 9.0)), "s"),)
        screen = ()
    walls = (
        Line((rng.uniform(1.0, 5.0), -right), (back - 0.5, -right), ROADSIDE),
        Line((back, -right), (back, left - 0.5), ACROSS, wing_m=8.0),
    )
    hedge = (Line((back - 1.0, left), (rng.uniform(1.0, 8.0), left), ("hedge", "trees", "concrete_wall")),)
    rows = [
        *_row(rng, 3.0 - right, x - 3.0, back - 4.0, 90.0),
        *_row(rng, rng.uniform(4.0, 5.5), x + 6.0, back - 4.0, 90.0),
        *_row(rng, left - 3.0, x - 3.0, back - 4.0, 90.0),
    ]
    zone = Zone((4.0, back - 1.0), (1.0 - right, left - 1.0), None)
    return Layout(blocks, (*walls, *hedge, *screen), (zone,), tuple(rows), (3, 10))


def _row(rng: np.random.Generator, y: float, start: float, end: float, heading_deg: float) -> list[Bay]:
    """Return the bays side by side along x."""
    return [Bay(x, y, heading_deg) for x in np.arange(start + rng.uniform(0.0, 3.0), end, BAY_WIDTH_M)]


_LAYOUTS: dict[PlaceKind, Callable[[np.random.Generator], Layout]] = {
    "street": _street,
    "parking_lot": _parking_lot,
    "residential_block": _residential_block,
    "mixed_intersection": _mixed_intersection,
}
