"""Distances in the plane, without compiled code, so that display code imports this quickly."""

from __future__ import annotations

import numpy as np


def segment_distance_m(points_m: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distance of points [N, 2] from segments a -> b [W, 2]; [N, W]."""
    along = b - a
    from_a = points_m[:, None] - a
    share = np.sum(from_a * along, axis=-1) / np.maximum(np.sum(along**2, axis=-1), 1e-12)
    return np.linalg.norm(from_a - np.clip(share, 0.0, 1.0)[..., None] * along, axis=-1)
