"""Building footprints as maps give them, before they are placed around a radar."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from msgs.values.wording import counted

#: Larger files are refused: cut the map to the streets that matter.
MAX_BYTES = 64 << 20
#: Points of all outlines of a file together.
MAX_POINTS = 500_000
#: Corners of a triangle.
MIN_CORNERS = 3

Position = tuple[float, float]


@dataclass(frozen=True)
class Footprint:
    """One part of a building: its outer ring, the rings of its courtyards, and what the map says about it."""

    #: Place in the file: "features[3].geometry", "way 42".
    field: str
    #: (longitude, latitude) in degrees, or (east, north) in metres; the last point is not the first again.
    outer: tuple[Position, ...]
    holes: tuple[tuple[Position, ...], ...]
    tags: Mapping[str, str]


@dataclass(frozen=True)
class FootprintFile:
    """Content of a map file."""

    footprints: tuple[Footprint, ...]
    #: Footprints that cannot be read: one line each.
    broken: tuple[str, ...]
    #: Whether positions are metres, not degrees.
    metric: bool
    #: What else the file holds, left out: kind and number.
    left_out: Mapping[str, int]
    #: Whose data it is, where its licence wants that said.
    attribution: str = ""


def check_size(path: Path) -> None:
    """Raise ValueError where a file is empty or larger than any map of some streets."""
    size = path.stat().st_size
    if not size:
        raise ValueError("must hold building footprints, got an empty file")
    if size > MAX_BYTES:
        raise ValueError(f"must hold at most {MAX_BYTES} bytes, got {size}: cut the map to the streets that matter")


def check_count(points: int) -> None:
    """Raise ValueError for more points than a map may have."""
    if points > MAX_POINTS:
        raise ValueError(f"must hold at most {MAX_POINTS} points of outlines, got more: cut the map")


def ring_of(field: str, positions: list[Position], metric: bool) -> tuple[Position, ...]:
    """Return a closed ring without its last point, which is the first again; ValueError, field first, for no ring."""
    for index, (x, y) in enumerate(positions):
        check_position(f"{field}[{index}]", x, y, metric)
    if len(positions) < MIN_CORNERS + 1 or positions[0] != positions[-1]:
        what = f"{counted(len(positions), 'point')}" if len(positions) < MIN_CORNERS + 1 else "an open line"
        raise ValueError(f"{field}: must be a closed ring of {MIN_CORNERS + 1} points or more, got {what}")
    return tuple(positions[:-1])


def check_position(field: str, x: float, y: float, metric: bool) -> None:
    """Raise ValueError, field first, for a position that is none."""
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ValueError(f"{field}: must be finite, got ({x!r}, {y!r})")
    if not metric and not (abs(x) <= 180.0 and abs(y) <= 90.0):
        raise ValueError(
            f"{field}: must be longitude and latitude in degrees (-180..180, -90..90), got ({x!r}, {y!r}); "
            "for a map in metres give --metric"
        )
