"""Walls known from another source than the radar's own scans: a map, a LiDAR, another radar; a place on the map."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from msgs.values.arrays import Checked, StampNs, require_finite, require_within

#: Walls of one message: each is compared with each wall of a scan.
MAX_PRIOR_WALLS = 256
#: Ends lie within this of the vehicle, in each coordinate; a shorter wall has no direction that serves as a mirror's.
MAX_WALL_DISTANCE_M, MIN_WALL_LENGTH_M, MAX_WALL_LENGTH_M = 1e4, 0.1, 2000.0
#: Least and largest standard deviations: none is zero, for that would outweigh whatever the radar measures.
WALL_STD_LIMITS: dict[str, tuple[float, float]] = {
    "offset_std_m": (1e-4, 100.0),
    "angle_std_rad": (1e-5, math.pi),
    "end_std_m": (1e-4, 1000.0),
}
MAX_SOURCE_LENGTH = 64
#: Where the east is undefined.
MAX_LATITUDE_DEG = 89.9


class PriorWall(msgspec.Struct, frozen=True, kw_only=True):
    """A straight wall in plan, by its ends; vehicle frame at the stamp of its message."""

    ends_m: tuple[tuple[float, float], tuple[float, float]]
    #: Standard deviation of the wall's position across it at its middle, and of its direction.
    offset_std_m: float
    angle_std_rad: float
    #: Standard deviation of each end along the wall.
    end_std_m: float

    def __post_init__(self) -> None:
        (ax, ay), (bx, by) = self.ends_m
        require_finite("wall.ends_m", ax, ay, bx, by)
        require_within("wall.ends_m", -MAX_WALL_DISTANCE_M, MAX_WALL_DISTANCE_M, ax, ay, bx, by)
        require_within("wall length in m", MIN_WALL_LENGTH_M, MAX_WALL_LENGTH_M, math.hypot(bx - ax, by - ay))
        for name, (least, largest) in WALL_STD_LIMITS.items():
            require_within(f"wall.{name}", least, largest, getattr(self, name))


class WallPriors(Checked, frozen=True, kw_only=True):
    """All walls that one source knows about the vehicle (topic `environment/walls`), vehicle frame at `stamp_ns`.

    A message replaces the earlier ones of its source; one without walls takes them back.
    """

    label: ClassVar[str] = "wall_priors"

    stamp_ns: StampNs
    #: Name of the map or sensor; sources are fused with each other.
    source: str
    walls: tuple[PriorWall, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= len(self.source) <= MAX_SOURCE_LENGTH:
            raise ValueError(f"wall_priors.source must have 1..{MAX_SOURCE_LENGTH} characters, got {len(self.source)}")
        if len(self.walls) > MAX_PRIOR_WALLS:
            raise ValueError(f"wall_priors.walls must be at most {MAX_PRIOR_WALLS}, got {len(self.walls)}")


class GnssPose(Checked, frozen=True, kw_only=True):
    """Place and heading of the vehicle's origin on a map, and their standard deviations (topic `vehicle/gnss`).

    WGS 84; the heading is from north, clockwise.
    """

    label: ClassVar[str] = "gnss"

    stamp_ns: StampNs
    latitude_deg: Annotated[float, Meta(ge=-MAX_LATITUDE_DEG, le=MAX_LATITUDE_DEG)]
    longitude_deg: Annotated[float, Meta(ge=-180.0, le=180.0)]
    heading_deg: Annotated[float, Meta(ge=-360.0, le=360.0)]
    position_std_m: Annotated[float, Meta(ge=0.0, le=100.0)]
    heading_std_deg: Annotated[float, Meta(ge=0.0, le=180.0)]
