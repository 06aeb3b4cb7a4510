"""The radar's frame of a map: metres forward and left of a position that looks along a heading."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from msgs.values.environment import MAX_LATITUDE_DEG

#: Half the greatest axis of the WGS 84 ellipsoid, and the square of its eccentricity.
WGS84_AXIS_M = 6_378_137.0
WGS84_ECCENTRICITY_SQUARED = 6.694_379_990_141e-3


@dataclass(frozen=True)
class MapPose:
    """A radar on a map: latitude, longitude in degrees, or x, y in metres; heading from north, clockwise."""

    first: float
    second: float
    heading_deg: float
    metric: bool = False

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.first, self.second, self.heading_deg))):
            raise ValueError(
                f"--position and --heading must be finite, got {self.first!r},{self.second!r} and {self.heading_deg!r}"
            )
        if not -360.0 <= self.heading_deg <= 360.0:
            raise ValueError(f"--heading must be -360..360 deg from north, clockwise, got {self.heading_deg!r}")
        if self.metric:
            return
        if abs(self.first) > MAX_LATITUDE_DEG:
            raise ValueError(f"--position: latitude must be within {MAX_LATITUDE_DEG} deg, got {self.first!r}")
        if abs(self.second) > 180.0:
            raise ValueError(f"--position: longitude must be -180..180 deg, got {self.second!r}")

    def local(self, positions: np.ndarray) -> np.ndarray:
        """Return positions of the map [N, 2] (longitude and latitude, or east and north) as x forward, y left."""
        east, north = self._metres(positions) if self.metric else self._tangent_plane(positions)
        sine, cosine = math.sin(math.radians(self.heading_deg)), math.cos(math.radians(self.heading_deg))
        return np.column_stack([sine * east + cosine * north, sine * north - cosine * east])

    def _metres(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return positions[:, 0] - self.first, positions[:, 1] - self.second

    def _tangent_plane(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return metres east and north (ENU by geocentric coordinates) in the radar's tangent plane."""
        latitude, longitude = math.radians(self.first), math.radians(self.second)
        offset = _geocentric(np.radians(positions[:, ::-1])) - _geocentric(np.array([[latitude, longitude]]))
        east = np.array([-math.sin(longitude), math.cos(longitude), 0.0])
        north = np.array(
            [
                -math.sin(latitude) * math.cos(longitude),
                -math.sin(latitude) * math.sin(longitude),
                math.cos(latitude),
            ]
        )
        return offset @ east, offset @ north


def _geocentric(geodetic_rad: np.ndarray) -> np.ndarray:
    """Return points of the ellipsoid's surface at latitudes and longitudes [N, 2], geocentric metres [N, 3]."""
    latitude, longitude = geodetic_rad.T
    curvature_m = WGS84_AXIS_M / np.sqrt(1.0 - WGS84_ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    level = curvature_m * np.cos(latitude)
    up = (1.0 - WGS84_ECCENTRICITY_SQUARED) * curvature_m * np.sin(latitude)
    return np.column_stack([level * np.cos(longitude), level * np.sin(longitude), up])
