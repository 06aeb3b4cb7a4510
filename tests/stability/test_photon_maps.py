"""Hard cases of photon maps: what a wall leaves of the light behind it."""

from __future__ import annotations

import numpy as np
import pytest

from models.perception.form.photon_map import photon_map, project_counts
from models.physics.photons.counting import draw_histogram
from msgs.values.lidar import LidarSetup, PhotonHistograms, SpadParams
from msgs.values.radar import RangeAzimuthGrid
from msgs.values.units import SPEED_OF_LIGHT_MPS
from tests.stability.catalogue import Errors

SPAD = SpadParams(arming="gated")
SETUP = LidarSetup(spad=SPAD, grid=RangeAzimuthGrid(azimuth_bins=64))
#: Cells behind the wall, within the period.
BEHIND = slice(17, 46)


def counts() -> np.ndarray:
    """A wall of 4 photons a pulse at 3 m: one period in 54 is left, and e^-2 of those at the end."""
    rng, wall = np.random.default_rng(5), (np.array([6.0 / SPEED_OF_LIGHT_MPS]), np.array([4.0]))
    return np.array([draw_histogram(SPAD, *wall, rng) for _ in range(64)]).astype("<u4")


@pytest.mark.hard("models.perception.form.photon_map", "counts less the mean count of the period, over its root", 0.14,
                  "",
                  "four errors of the mean square of 29 x 64 normal values, with counts of 90 a cell on "
                  "average")  # fmt: skip
def test_light_behind_a_wall(errors: Errors) -> None:
    """54 times less light is counted behind than before: it is not an echo's absence. Mean square less 1."""
    found = counts()
    cells = project_counts(found, SPAD, SETUP.grid)
    mean = cells[1:47].mean(axis=0)
    stamps = np.zeros(64, np.int64)
    values = photon_map(SETUP, PhotonHistograms(stamp_ns=0, scan_id=0, counts=found, azimuth_stamp_ns=stamps)).values
    errors(
        naive=abs(float(np.mean((cells[BEHIND] - mean) ** 2 / mean)) - 1.0),
        ours=abs(float(np.mean(values.real[BEHIND] ** 2)) - 1.0),
    )
