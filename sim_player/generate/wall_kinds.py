"""Kinds of wall a place is built of: the surfaces that serve as mirrors, and some that do not.

Thickness and roughness by finish, in the bands of textbooks (glass and metal nearly smooth, painted plaster 0.05-0.2
mm, concrete and brick 0.2-1.5 mm, render 1-2 mm rms). Containers are smooth.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Literal

import numpy as np
from msgspec.structs import replace

from models.physics.materials import band_note, is_volume, wall_layers
from msgs.values.radar import PRESETS
from sim_player.scene.description import Point, Surface


@dataclass(frozen=True)
class Finish:
    """A material as built: bands that thickness and rms roughness are drawn from."""

    material: str
    thickness_mm: tuple[float, float]
    roughness_mm: tuple[float, float]


FINISHES: dict[str, Finish] = {
    "concrete": Finish("concrete", (150.0, 400.0), (0.2, 0.5)),
    "painted": Finish("concrete", (150.0, 300.0), (0.05, 0.2)),
    "rendered": Finish("concrete", (150.0, 300.0), (1.0, 2.0)),
    "brick": Finish("brick", (240.0, 365.0), (0.5, 1.5)),
    "garden_brick": Finish("brick", (115.0, 240.0), (0.5, 1.5)),
    "glass": Finish("glass", (4.0, 12.0), (0.01, 0.05)),
    "metal": Finish("metal", (1.5, 3.0), (0.01, 0.05)),
    "panel": Finish("concrete", (100.0, 150.0), (0.2, 1.0)),
    "hedge": Finish("vegetation", (400.0, 1000.0), (0.0, 0.0)),
    "crown": Finish("vegetation", (1000.0, 2500.0), (0.0, 0.0)),
}
#: Along-wall distance over which roughness stays alike.
CORRELATION_MM = (5.0, 100.0)
#: ISO containers: lengths, width, height.
CONTAINER_M, CONTAINER_WIDTH_M, CONTAINER_HEIGHT_M = (6.06, 12.19), 2.44, 2.59
CURVATURE_PER_M = (0.005, 0.06)
#: An arc turns by no more than this, |curvature| x chord.
MAX_TURN = 1.4
#: Sound barriers follow roads, whose bends are wide.
BARRIER_CURVATURE_PER_M = 0.008

Preset = Literal["xband", "77ghz"]
RelayKind = Literal[
    "facade",
    "concrete_wall",
    "brick_wall",
    "glass_front",
    "sound_barrier",
    "container",
    "hedge",
    "trees",
    "curved_wall",
    "corner",
]


@dataclass(frozen=True)
class Line:
    """Line of a wall in plan: from start to end in metres, its front on the left of that direction."""

    start: Point
    end: Point
    kinds: tuple[RelayKind, ...]
    height_m: tuple[float, float] = (2.5, 10.0)
    #: How far an arc may leave the straight line.
    room_m: float = 1.5
    #: Greatest length of a corner's other wall.
    wing_m: float = 6.0

    @property
    def length_m(self) -> float:
        """Distance of its ends."""
        return math.dist(self.start, self.end)

    def at(self, along_m: float, left_m: float = 0.0) -> Point:
        """Return the point so far along the line and so far in front of it."""
        x, y = ((b - a) / self.length_m for a, b in zip(self.start, self.end, strict=True))
        return (
            float(self.start[0] + along_m * x - left_m * y),
            float(self.start[1] + along_m * y + left_m * x),
        )


@lru_cache(maxsize=64)
def known(material: str, preset: Preset) -> bool:
    """Return whether a material was measured in the band of a radar: places draw no interpolated ones."""
    carrier_hz = PRESETS[preset].radar.carrier_hz
    try:
        if not is_volume(material):
            wall_layers(material, 0.1, carrier_hz)
    except ValueError:
        return False
    return not band_note(material, carrier_hz)


def kinds_at(preset: Preset) -> tuple[RelayKind, ...]:
    """Return the kinds of wall of which some finish is known with a radar."""
    return tuple(kind for kind, (_, finishes) in _BUILDERS.items() if _finishes(finishes, preset))


def build(rng: np.random.Generator, line: Line, preset: Preset) -> tuple[RelayKind, tuple[Surface, ...]]:
    """Return a wall of one of the line's kinds, of concrete where none of them is known with this radar."""
    allowed = kinds_at(preset)
    kinds = [kind for kind in line.kinds if kind in allowed] or ["concrete_wall"]
    kind: RelayKind = kinds[rng.integers(len(kinds))]
    builder, names = _BUILDERS[kind]
    finishes = _finishes(names, preset)
    return kind, builder(rng, line, FINISHES[finishes[rng.integers(len(finishes))]])


def surface(
    rng: np.random.Generator,
    finish: Finish,
    polyline_m: tuple[Point, ...],
    height_m: float,
    curvature_per_m: float = 0.0,
    role: Literal["relay", "occluder"] = "relay",
) -> Surface:
    """Return an upright wall of a finish, thickness and roughness drawn from its bands."""
    return Surface(
        role=role,
        material=finish.material,
        polyline_m=polyline_m,
        height_m=height_m,
        thickness_mm=float(rng.uniform(*finish.thickness_mm)),
        roughness_mm=_log_uniform(rng, *finish.roughness_mm) if finish.roughness_mm[0] else 0.0,
        correlation_mm=_log_uniform(rng, *CORRELATION_MM),
        curvature_per_m=curvature_per_m,
    )


def _facade(rng: np.random.Generator, line: Line, finish: Finish) -> tuple[Surface, ...]:
    """Return the piers of the finish with windows between, all in one plane."""
    count = int(np.clip(line.length_m / rng.uniform(3.0, 5.5), 1, 5))
    share = rng.uniform(0.3, 0.6)  # of the front that is glass
    pier, window = (1.0 - share) * line.length_m / (count + 1), share * line.length_m / count
    edges = np.cumsum([0.0] + [pier, window] * count + [pier])
    height_m = float(rng.uniform(*line.height_m))
    wall, pane = surface(rng, finish, (), height_m), surface(rng, FINISHES["glass"], (), height_m)
    return tuple(
        replace(pane if index % 2 else wall, polyline_m=(line.at(low), line.at(high)))
        for index, (low, high) in enumerate(pairwise(edges))
    )


def _plain(rng: np.random.Generator, line: Line, finish: Finish) -> tuple[Surface, ...]:
    """Return one straight wall."""
    return (surface(rng, finish, (line.start, line.end), float(rng.uniform(*line.height_m))),)


def _sound_barrier(rng: np.random.Generator, line: Line, finish: Finish) -> tuple[Surface, ...]:
    """Return the panels of metal or concrete, half of them along a slight curve."""
    widest = min(BARRIER_CURVATURE_PER_M, 8.0 * line.room_m / line.length_m**2)
    curvature = float(rng.uniform(-widest, widest)) if rng.random() < 0.5 else 0.0
    return (surface(rng, finish, (line.start, line.end), float(rng.uniform(2.5, 5.0)), curvature),)


def _containers(rng: np.random.Generator, line: Line, finish: Finish) -> tuple[Surface, ...]:
    """Return the containers of one length in a row along the line, as many as fit, at least one."""
    length_m = CONTAINER_M[int(line.length_m > CONTAINER_M[1] and rng.random() < 0.5)]
    count = max(int(line.length_m / (length_m + 0.5)), 1)
    starts = np.arange(min(count, 3)) * (length_m + rng.uniform(0.1, 0.5))
    starts += rng.uniform(0.0, max(line.length_m - starts[-1] - length_m, 1e-3))
    rows = [Line(line.at(start), line.at(start + length_m), line.kinds) for start in starts]
    outlines = [
        (row.start, row.end, *(row.at(along_m, -CONTAINER_WIDTH_M) for along_m in (row.length_m, 0.0)), row.start)
        for row in rows
    ]
    return tuple(surface(rng, finish, outline, CONTAINER_HEIGHT_M) for outline in outlines)


def _hedge(rng: np.random.Generator, line: Line, finish: Finish) -> tuple[Surface, ...]:
    """Return a clipped hedge: a volume that scatters and absorbs."""
    return _plain(rng, dataclasses.replace(line, height_m=(1.2, 2.5)), finish)


def _trees(rng: np.random.Generator, line: Line, finish: Finish) -> tuple[Surface, ...]:
    """Return a row of trees, each a short piece as wide as its crown."""
    height_m, spacing = float(rng.uniform(4.0, 10.0)), rng.uniform(4.0, 8.0)
    starts = np.arange(0.0, max(line.length_m - 2.5, 0.1), spacing)
    return tuple(
        surface(rng, finish, (line.at(start), line.at(start + rng.uniform(1.0, 2.5))), height_m) for start in starts
    )


def _curved_wall(rng: np.random.Generator, line: Line, finish: Finish) -> tuple[Surface, ...]:
    """Return one arc, hollow or bulging towards its front; shortened where its bulge would not find room."""
    least, widest = CURVATURE_PER_M
    chord = min(line.length_m, math.sqrt(8.0 * line.room_m / least))
    widest = max(min(widest, MAX_TURN / chord, 8.0 * line.room_m / chord**2), least)
    curvature = _log_uniform(rng, least, widest) * (1.0 if rng.random() < 0.5 else -1.0)
    height_m = float(rng.uniform(*line.height_m))
    return (surface(rng, finish, (line.start, line.at(chord)), height_m, curvature),)


def _corner(rng: np.random.Generator, line: Line, finish: Finish) -> tuple[Surface, ...]:
    """Return two walls that meet at a right angle at the line's end, open to the front."""
    wing = line.at(line.length_m, float(rng.uniform(0.5, 1.0)) * line.wing_m)
    return (surface(rng, finish, (line.start, line.end, wing), float(rng.uniform(*line.height_m))),)


Builder = Callable[[np.random.Generator, Line, Finish], tuple[Surface, ...]]
_MASONRY = ("concrete", "painted", "rendered", "brick")
#: How each kind is built, and of which finishes.
_BUILDERS: dict[RelayKind, tuple[Builder, tuple[str, ...]]] = {
    "facade": (_facade, _MASONRY),
    "concrete_wall": (_plain, ("concrete", "painted", "rendered")),
    "brick_wall": (_plain, ("brick", "garden_brick")),
    "glass_front": (_plain, ("glass",)),
    "sound_barrier": (_sound_barrier, ("metal", "panel")),
    "container": (_containers, ("metal",)),
    "hedge": (_hedge, ("hedge",)),
    "trees": (_trees, ("crown",)),
    "curved_wall": (_curved_wall, (*_MASONRY, "glass", "metal")),
    "corner": (_corner, (*_MASONRY, "metal")),
}


def _finishes(names: tuple[str, ...], preset: Preset) -> list[str]:
    """Return those finishes whose material is known with a radar."""
    return [name for name in names if known(FINISHES[name].material, preset)]


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a number whose logarithm is uniform."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))
