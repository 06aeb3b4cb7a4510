"""Purposes by name, and the paths that the law of objects is about."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from msgs.values.perception import PathClass
from msgs.values.radar import RadarSetup
from sim_player.effects.table import ALL_EFFECTS
from sim_player.planner.purposes import DETECTION, Purpose, _seen, object_paths, purpose_of
from sim_player.scene.description import Scene, SceneObject, Surface
from sim_player.scene.world import prepare
from sim_player.trace.ray_tracing import trace
from tests.sim_player.planner.test_plan import CAR, WALL
from tests.sim_player.signal.test_levels import some_paths

SCREEN = Surface(role="occluder", material="metal", polyline_m=((8.0, 2.4), (8.0, 10.0)), height_m=6.0)


def test_names() -> None:
    assert [purpose_of(word) for word in ("samples", "peaks", "objects")] == list(Purpose)
    with pytest.raises(ValueError, match="purpose must be one of samples, peaks, objects, got 'maps'"):
        purpose_of("maps")


def test_the_threshold_is_the_detectors() -> None:
    """13 dB over the noise of a cell."""
    assert 20.0 * np.log10(DETECTION) == pytest.approx(13.0)


def test_images_of_hidden_objects_and_their_walls() -> None:
    """A screen hides the car: its images in the wall and the wall's own echoes count, the screen's do not.

    Without the screen the car is in plain sight, and nothing counts.
    """
    rms = np.full(512, 1e-9)
    hidden = Scene(name="t", surfaces=(WALL, SCREEN), objects=(CAR,))
    paths = trace(prepare(hidden), 0.0, ALL_EFFECTS)
    mine = paths.take(object_paths(hidden.setup, paths, rms))
    images = mine.kind == PathClass.MIRRORED
    assert images.any()
    assert (mine.object_index[images] == 0).all()
    assert (~images).any()
    assert (mine.object_index[~images] == -1).all()
    assert set(mine.surface[~images]) <= set(mine.surface[images])
    open_view = Scene(name="t", surfaces=(WALL,), objects=(SceneObject(class_="car", x_m=12.0, y_m=6.0),))
    seen = trace(prepare(open_view), 0.0, ALL_EFFECTS)
    assert not object_paths(open_view.setup, seen, rms).any()


def test_a_path_is_seen_over_the_noise_of_its_own_range_bin() -> None:
    """40 m there and back are 20 m: bin 93, not 187, whose noise hides everything."""
    setup, noise_rms = RadarSetup(), np.full(512, 1e-12)
    noise_rms[150:] = 1e6
    paths = replace(some_paths(1, 50.0), length_m=np.array([40.0]), azimuth_rad=np.zeros(1))
    assert _seen(setup, paths, np.ones(1, bool), noise_rms).tolist() == [True]
    assert _seen(setup, paths, np.ones(1, bool), noise_rms[::-1].copy()).tolist() == [False]
