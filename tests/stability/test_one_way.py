"""Hard cases of an array that steers receive alone, on a board whose columns are not alike."""

from __future__ import annotations

import numpy as np
import pytest

from contrib.boards.phaser_model import PhaserCalibration, PhaserParams, beam_table, radar_params, radar_setup
from models.perception.form.coarray import AzimuthInterpolator, ideal_beams
from msgs.values.radar import BeamGrid
from tests.stability.catalogue import Errors

PARAMS = PhaserParams()
#: Gains measured on a board, 1 at the weakest column; phases of about the spread such boards have.
BOARD = PhaserCalibration(
    gains=(0.638, 0.813, 0.790, 0.974, 0.770, 0.800, 0.614, 1.0),
    phases_deg=(0.0, 14.0, -33.0, 80.0, 122.0, -61.0, 9.0, 170.0),
)


def _map_error(weights: np.ndarray | None, real: np.ndarray, azimuth_deg: float) -> float:
    """Largest error of a point's row over its peak, where beams are `real` and the set-up says `weights`."""
    setup = radar_setup(PARAMS, BeamGrid(), weights)
    phase = 2.0 * np.pi / setup.radar.wavelength_m * PARAMS.column_spacing_m * (np.arange(8) - 3.5)
    echo = np.exp(-1j * phase * np.sin(np.radians(azimuth_deg)))
    interpolator = AzimuthInterpolator(setup)
    beams = (real.conj() @ echo / np.sqrt(8.0)).astype(np.complex64)[:, None]
    row = interpolator.interpolate(beams, np.inf)[0][0]
    exact = ideal_beams(setup, interpolator.grid.azimuth_rad) @ echo
    return float(np.abs(row - exact).max() / np.sqrt(8.0))


@pytest.mark.hard("contrib.boards.phaser_model", "weights of the phases that were asked for", 2e-5, "of the peak",
                  "ridge of 1e-7; beams in float32")  # fmt: skip
def test_rounded_calibrated_phases(errors: Errors) -> None:
    """Calibration plus steering is rounded to 2.8 degrees in the register: every column keeps another rest."""
    table = beam_table(PARAMS, BOARD, BeamGrid())
    board = np.exp(-1j * np.radians(BOARD.phases_deg)) / np.array(BOARD.gains)
    real = board * table.gain_codes / 127.0 * np.exp(1j * np.radians(table.phases_deg))
    wave = 2.0 * np.pi / radar_params(PARAMS).wavelength_m * PARAMS.column_spacing_m * (np.arange(8) - 3.5)
    asked = np.exp(-1j * np.multiply.outer(np.sin(BeamGrid().azimuth_rad), wave)).astype(np.complex64)
    errors(naive=_map_error(asked, real, 20.0), ours=_map_error(table.weights, real, 20.0))
