"""Parts of a recovered position's error: a facade 12 m ahead, taken to be 12.5 m away."""

from __future__ import annotations

import numpy as np

from benchmarks.perception.residual_causes import BOUNDS, Places, errors
from lab.training.data.frames import FrameLabels
from msgs.values.frames import polar_from_xy
from msgs.values.perception import PathClass

PLACE_M = np.array([[6.0, 3.0]])


def places() -> Places:
    """A hidden place, its image 0.3 m too near and 0.4 m too far left, and an image of nothing."""
    true_image_m = np.array([[18.0, 3.0]])
    range_m, azimuth_rad = polar_from_xy(true_image_m)
    labels = FrameLabels(
        range_m=range_m, azimuth_rad=azimuth_rad, path_class=np.array([PathClass.MIRRORED]), order=np.array([1]),
        hidden_xy_m=PLACE_M, power_mw=np.ones(1), object_index=np.zeros(1, int), object_class=np.array(["car"]),
    )  # fmt: skip
    images_m = np.array([[17.7, 3.4], [30.0, -9.0]])
    folded_m = np.array([25.0, 0.0]) + images_m * [-1.0, 1.0]
    return Places((), folded_m, np.zeros_like(folded_m), *errors(images_m, folded_m, labels))


def test_an_error_is_that_of_the_image_and_that_of_the_wall() -> None:
    scene = places()
    # folding turns the image's error over, and a wall half a metre too far puts a place a metre too far
    np.testing.assert_allclose(scene.image_error_m[0], [-0.3, -0.4], atol=1e-9)
    np.testing.assert_allclose(scene.wall_error_m[0], [-1.0, 0.0], atol=1e-9)
    assert np.isnan(scene.error_m[1])
    assert scene.order.tolist() == [1, 0]


def test_bounds_mend_what_they_name() -> None:
    scene = places()
    errors_m = {name: float(np.linalg.norm(scene.moved(name)[0] - PLACE_M[0])) for name in BOUNDS}
    assert np.allclose(list(errors_m.values()), [np.hypot(1.3, 0.4), np.hypot(1.3, 0.4), 0.5, 0.0, 0.5])
