"""The hidden surface in a reconstructed volume: brightness, depth, and the plane that fits it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lab.transients.scan import ConfocalTransients

#: Pixels below this share of the brightest are background.
DEFAULT_THRESHOLD = 0.3


@dataclass(frozen=True, eq=False)
class HiddenShape:
    """A surface over the wall's grid; depths are distances from the wall along its normal."""

    #: Largest reflectance over depth, relative to the brightest pixel, and its depth; [points, points].
    brightness: np.ndarray
    depth_m: np.ndarray
    #: Pixels that are no background.
    lit: np.ndarray
    #: Depth = plane[0] + plane[1] x + plane[2] y of the lit pixels, by their brightness.
    plane: tuple[float, float, float]

    @property
    def distance_m(self) -> float:
        """Mean depth of the lit pixels, by their brightness."""
        return float(np.average(self.depth_m[self.lit], weights=self.brightness[self.lit]))

    @property
    def tilt_rad(self) -> float:
        """Angle between the plane and the wall."""
        return math.atan(math.hypot(*self.plane[1:]))


def hidden_shape(volume: np.ndarray, scan: ConfocalTransients, threshold: float = DEFAULT_THRESHOLD) -> HiddenShape:
    """Return the surface of a volume [points, points, bins] over depth.

    Raises `ValueError` for a threshold outside 0..1, 0 excluded, and where the volume is dark.
    """
    if not 0.0 < threshold <= 1.0:
        raise ValueError(f"threshold must lie in 0..1, 0 excluded, got {threshold!r}")
    brightness = volume.max(axis=2).astype(np.float64)
    if not brightness.max() > 0.0:
        raise ValueError("counts must show something behind the wall's own return, got a dark volume")
    brightness /= brightness.max()
    depth_m = scan.range_m[volume.argmax(axis=2)]
    lit = brightness >= threshold
    x_m, y_m = np.meshgrid(scan.wall_m, scan.wall_m, indexing="ij")
    terms = np.stack([np.ones(int(lit.sum())), x_m[lit], y_m[lit]], axis=1)
    weight = brightness[lit]
    # fewer lit pixels than terms: the flattest plane through them
    plane = np.linalg.lstsq(terms * weight[:, None], depth_m[lit] * weight, rcond=None)[0]
    return HiddenShape(brightness, depth_m, lit, (float(plane[0]), float(plane[1]), float(plane[2])))
