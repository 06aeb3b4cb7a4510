"""The view stage: what it was made with reaches its views."""

from __future__ import annotations

import numpy as np
import pytest

from models.perception.mirrors.peaks_to_view import synthetic_peaks
from models.perception.track.views_over_scans import ViewStage


def test_a_learned_residual_moves_every_hidden_point() -> None:
    """A residual of (0.25, -0.5) m: all points so much further, their images where they were."""
    offset_m = np.array([0.25, -0.5])
    plain = ViewStage().view(synthetic_peaks())
    moved = ViewStage(residual=lambda seen: np.tile(offset_m, (len(seen.images_m), 1))).view(synthetic_peaks())
    assert len(moved.points) == len(plain.points) == 1
    for one, other in zip(plain.points, moved.points, strict=True):
        assert (other.x_m, other.y_m) == pytest.approx((one.x_m + 0.25, one.y_m - 0.5))
        assert (other.image_x_m, other.image_y_m) == (one.image_x_m, one.image_y_m)
