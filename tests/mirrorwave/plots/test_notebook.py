"""Values as pictures in a notebook, and as lines elsewhere."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from mirrorwave.api import View, views
from mirrorwave.plots.notebook import PICTURES, frame_png, map_png, scene_png, show_values_as_pictures
from msgs.files.shipped import LAUNCH, SAMPLE
from msgs.values.perception import BevFrame
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from sim_player.scene.description import Scene, load_scene
from tests.builders import example_map

PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def view() -> View:
    return next(views(SAMPLE, profile="cfar"))


def small_map(value: complex = 1.0, noise_power_mw: float = 1e-12) -> RangeAzimuthMap:
    grid = RangeAzimuthGrid(range_bins=8, azimuth_bins=4)
    return example_map(np.full((8, 4), value, np.complex64), scan_id=3, grid=grid, noise_power_mw=noise_power_mw)


@pytest.mark.slow
def test_a_view_is_a_picture_in_a_notebook_and_a_line_elsewhere(view: View) -> None:
    assert view._repr_png_().startswith(PNG)
    assert repr(view).startswith("View(scan 4, ")
    assert repr(view).endswith(", truth)")
    assert len(repr(view)) < 120
    alone = msgspec.structs.replace(view, ra_map=None, truth=None)
    assert alone._repr_png_().startswith(PNG)
    assert "truth" not in repr(alone)
    assert frame_png(view.frame).startswith(PNG)


def test_a_map_says_what_it_is() -> None:
    line = "RangeAzimuthMap(scan 3, 8 x 4 cells to 1.5 m and +-60 deg, coherent, noise -120.0 dBm a bin)"
    assert repr(small_map()) == line
    assert repr(small_map(noise_power_mw=0.0)).endswith("noise unknown)")


@pytest.mark.parametrize("value", [0.0, 1.0, 1e38])
def test_any_map_is_drawn(value: float) -> None:
    assert map_png(small_map(value)).startswith(PNG)


def test_a_scene_is_drawn() -> None:
    assert scene_png(load_scene(LAUNCH / "scenes" / "corner.yaml")).startswith(PNG)


def test_types_are_those_that_are_registered() -> None:
    types = {(kind.__module__, kind.__name__) for kind in (RangeAzimuthMap, BevFrame, Scene)}
    assert set(PICTURES) == types


def test_outside_a_notebook_nothing_is_registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "IPython", None)
    show_values_as_pictures()
    code = "import sys, mirrorwave.api; sys.exit('matplotlib' in sys.modules or 'IPython' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


class Formatter:
    def __init__(self) -> None:
        self.drawn: dict[tuple[str, str], Callable[[Any], bytes]] = {}

    def for_type_by_name(self, module: str, name: str, draw: Callable[[Any], bytes]) -> None:
        self.drawn[module, name] = draw


@pytest.mark.parametrize("formats", [{}, {"image/png": Formatter()}])
def test_a_terminal_without_pictures_is_left_alone(
    formats: dict[str, Formatter], monkeypatch: pytest.MonkeyPatch
) -> None:
    shell = type("Shell", (), {"display_formatter": type("Display", (), {"formatters": formats})})
    monkeypatch.setitem(sys.modules, "IPython", type("IPython", (), {"get_ipython": staticmethod(lambda: shell)}))
    show_values_as_pictures()
    assert all(formatter.drawn == PICTURES for formatter in formats.values())
