from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from models.perception.mirrors.peaks_to_view import GeometryParams, recover_bev, synthetic_peaks
from msgs.files.shipped import CHECKOUT

#: In a process of its own, where nothing has been compiled or loaded yet.
CHILD = """
import importlib
import numpy as np
from numba.core.dispatcher import Dispatcher
from tests.models.perception.mirrors.place_peaks import place_peaks
from models.perception.mirrors.peaks_to_view import GeometryParams, recover_bev, warm

ROOMS = ("perception.mirrors.lines", "perception.mirrors.wall_search", "perception.mirrors.arcs",
         "perception.mirrors.clustering", "perception.mirrors.observability", "physics.mirror")

def compiled():
    rooms = [vars(importlib.import_module("models." + room)) for room in ROOMS]
    return {(name, str(types)) for room in rooms for name, one in room.items() if isinstance(one, Dispatcher)
            for types in one.signatures}

scans = list(place_peaks(seed=4, count=12))
warm(GeometryParams())
before = compiled()
for peaks in scans:
    recover_bev(peaks, GeometryParams())
    for array in (peaks.range_m, peaks.azimuth_rad, peaks.covariance, peaks.score, peaks.snr_db):
        array.flags.writeable = False
    recover_bev(peaks, GeometryParams())
print(sorted(compiled() - before), len(before) > 0)
"""


@pytest.mark.slow
def test_after_warming_no_scan_compiles_anything() -> None:
    """Nor do arrays as messages bring them, read-only."""
    child = subprocess.run([sys.executable, "-c", CHILD], cwd=CHECKOUT, capture_output=True, text=True)
    assert child.stdout.strip() == "[] True", child.stdout + child.stderr


def test_warming_scan_reaches_walls_images_and_what_explains_them() -> None:
    """Two walls at an angle, three images of which two fold to the vehicle that stands in sight."""
    view = recover_bev(synthetic_peaks(), GeometryParams())
    assert (len(view.walls), len(view.points)) == (2, 1)


def test_equal_scans_give_equal_bytes() -> None:
    one, other = (recover_bev(synthetic_peaks(), GeometryParams()) for _ in range(2))
    assert (one.walls, one.points, one.objects) == (other.walls, other.points, other.objects)
    np.testing.assert_array_equal(one.visibility, other.visibility)
