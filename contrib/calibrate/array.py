"""A capture of single elements to the calibration file that the driver loads."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import yaml

from contrib.boards.phaser_model import PhaserCalibration
from contrib.calibrate.background import mean_chirp
from contrib.calibrate.capture import Capture, complete_scans
from contrib.calibrate.element_calibration import (
    ElementResponses,
    board_calibration,
    columns_of_elements,
    element_responses,
)
from msgs.files.whole_files import write_whole
from msgs.values.arrays import require_within

#: A code at an end of the int16 scale.
_SATURATED = 32767


def measure_array(
    capture: Capture, range_m: tuple[float, float], azimuth_deg: float, scans: int,
    on_scan: Callable[[], None] = lambda: None,
) -> tuple[PhaserCalibration, ElementResponses]:  # fmt: skip
    """Calibration of a board from up to so many scans of single elements; ValueError naming the file."""
    require_within("azimuth_deg", -60.0, 60.0, azimuth_deg)
    try:
        columns_of_elements(capture.setup)
        chirps = _chirps(capture, scans, on_scan)
        responses = element_responses(capture.setup, chirps, range_m)
        return board_calibration(capture.setup, responses, math.radians(azimuth_deg)), responses
    except ValueError as error:
        raise ValueError(str(error) if str(capture.path) in str(error) else f"{capture.path}: {error}") from None


def _chirps(capture: Capture, scans: int, on_scan: Callable[[], None]) -> np.ndarray:
    """Mean chirps of complete scans, complex [scans, 8, samples]; ValueError where a converter was at its limit."""
    setup = capture.setup
    shape = setup.radar.chirps_per_beam, setup.radar.samples_per_chirp, 2
    chirps = np.zeros((0, len(setup.beams), shape[1]), np.complex64)
    for scan in complete_scans(capture.beams(), len(setup.beams), on_scan, scans):
        for beam in scan:
            if beam.samples.shape != shape:
                raise ValueError(f"beam.samples must have shape {shape}, got {beam.samples.shape}")
            if np.abs(beam.samples.astype(np.int32)).max() >= _SATURATED:
                raise ValueError(
                    f"samples must stay under full scale, those of element {beam.beam_index + 1} do not: "
                    "lower receive_gain_db"
                )
        chirps = np.concatenate([chirps, np.stack([mean_chirp(beam) for beam in scan])[None]])
    return chirps


def write_calibration(out: Path, calibration: PhaserCalibration, responses: ElementResponses) -> None:
    """The file, with what it rests on as a comment."""
    note = (
        f"# reflector at {responses.range_m:.2f} m, {responses.snr_db.min():.1f} dB over the noise of the weakest "
        f"element, phases within {responses.phase_std_deg.max():.2f} deg from scan to scan\n"
    )
    fields = {name: list(value) for name, value in msgspec.to_builtins(calibration).items()}
    write_whole(out, (note + yaml.safe_dump(fields, sort_keys=False, default_flow_style=None)).encode())


def element_rows(calibration: PhaserCalibration, responses: ElementResponses) -> list[tuple[str, ...]]:
    """Number, gain, phase, SNR and spread of each element, for a table."""
    columns = (calibration.gains, calibration.phases_deg, responses.snr_db, responses.phase_std_deg)
    return [(str(index), *(f"{value:.2f}" for value in row)) for index, row in enumerate(zip(*columns, strict=True), 1)]
