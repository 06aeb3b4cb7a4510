"""The column of smooth layers: when a run ends."""

from __future__ import annotations

import pytest

from lab.full_wave.cpml import SPEED_OF_LIGHT_MPS
from lab.full_wave.strip import StripParams, build_strips, run_strip
from models.physics.fresnel import Polarisation

FREQUENCY_HZ = 10e9


@pytest.mark.parametrize("polarisation", ["te", "tm"])
def test_a_slab_that_rings_on_is_left_after_40_pulses(polarisation: Polarisation) -> None:
    """25 wavelengths of permittivity 10,000 keep 0.96 of the field over each way there and back, of 404 steps.

    At 8 cells a wavelength and a Courant number of 0.99 the pulse's standard deviation is 8 / (2 pi 0.08 0.99) = 16.08
    steps, its length 12 of them, 192 whole steps: the run ends after 7,680 with the field still there.
    """
    wall, _ = build_strips(((1e4, 0.25 * SPEED_OF_LIGHT_MPS / FREQUENCY_HZ),), 0.0, FREQUENCY_HZ, StripParams(8))
    found = run_strip(wall, FREQUENCY_HZ, polarisation, StripParams(8))
    assert found.steps == 40 * 192
    assert found.residue > 1e-3
