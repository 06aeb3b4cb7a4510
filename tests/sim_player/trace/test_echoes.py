"""Echoes: the radar equation, and which routes are joined."""

from __future__ import annotations

import math

import numpy as np
import pytest

from msgs.values.radar import RadarParams
from sim_player.trace.echoes import echo_amplitude, same_target

RADAR = RadarParams()


@pytest.mark.parametrize("range_m", [5.0, 10.0, 20.0, 50.0, 100.0])
def test_radar_equation(range_m: float) -> None:
    """1 m^2 without antenna: P lambda^2 / ((4 pi)^3 R^4), in mW; tolerance: rounding."""
    power_mw = 1.6 * RADAR.wavelength_m**2 / ((4.0 * math.pi) ** 3 * range_m**4)
    assert echo_amplitude(RADAR, np.array([1.0]), np.array([range_m]))[0] ** 2 == pytest.approx(
        power_mw, rel=1e-12, abs=0.0
    )


def test_every_route_out_meets_every_route_back_of_its_target() -> None:
    """Targets reached by several routes, by one and by none, in no order: all pairs of one target, each once."""
    out, back = np.array([7, 2, 7, 5, 0]), np.array([2, 7, 4, 7, 2, 7])
    pairs = sorted(zip(*(indices.tolist() for indices in same_target(out, back)), strict=True))
    assert pairs == [(0, 1), (0, 3), (0, 5), (1, 0), (1, 4), (2, 1), (2, 3), (2, 5)]
    assert all(len(indices) == 0 for indices in same_target(out, np.array([], np.int64)))
