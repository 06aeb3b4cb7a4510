"""A target list as a map: what the radar that the networks were trained for would measure of the same returns.

Each return is a tone of its range in each beam, as strong as its SNR and the array's pattern say; phases are those of
its range. So one pair of networks judges lists and maps alike.
"""

from __future__ import annotations

from functools import lru_cache

import msgspec
import numpy as np
from scipy.sparse import csr_array

from models.perception.form.coarray import AzimuthInterpolator
from models.perception.form.ra_forming import ScanProfiles, form_map
from models.physics.antenna import setup_weights, two_way_pattern
from models.physics.waveform import beat_phase_rad, tone_profile
from msgs.values.perception import Peaks
from msgs.values.radar import RadarSetup, RangeAzimuthMap, speed_codes

#: The radar that the networks were trained for.
SETUP = RadarSetup()
#: Range bins to either side of a return that its profile fills.
SIDE_BINS = 8


def list_map(peaks: Peaks) -> RangeAzimuthMap:
    """Return the map of a list's returns, whatever their classes, at the time and place of the list.

    The noise of a beam is 1 mW a bin, the same draw in every scan: it carries nothing.
    """
    field = two_way_pattern(SETUP, setup_weights(SETUP), peaks.azimuth_rad, np.zeros(len(peaks)))
    # in its best beam a return is as strong as the list says, wherever it is
    field /= np.maximum(np.abs(field).max(axis=0), np.finfo(np.float64).tiny)
    amplitude = field.conj() * 10.0 ** (0.05 * peaks.snr_db)
    profiles = (_tones(peaks.range_m).T @ amplitude.T).T + _noise()
    scan = ScanProfiles(
        stamp_ns=peaks.stamp_ns,
        scan_id=peaks.scan_id,
        profiles=profiles.astype(np.complex64),
        noise_power_mw=1.0,
        # a list is of one time
        beam_stamp_ns=np.full(len(SETUP.beams), peaks.stamp_ns),
    )
    return msgspec.structs.replace(
        form_map(scan, _interpolator()),
        vehicle_from_radar=peaks.vehicle_from_radar,
        ego_compensated=peaks.ego_compensated,
        radial_speed_cmps=_speed_codes(peaks),
    )


def _tones(range_m: np.ndarray) -> csr_array:
    """Return the range profiles of unit returns, to where their side lobes are 80 dB down; [N, range]."""
    bins, samples = SETUP.map_grid.range_bins, SETUP.radar.samples_per_chirp
    at = SETUP.map_grid.range_index(range_m)
    first = np.rint(at).astype(np.int64) - SIDE_BINS
    values = tone_profile(samples, at - first, 2 * SIDE_BINS + 1)
    values = values * np.exp(1j * beat_phase_rad(SETUP.radar, 2.0 * range_m))[:, None]
    column = first[:, None] + np.arange(2 * SIDE_BINS + 1)
    inside = (column >= 0) & (column < bins)
    row = np.broadcast_to(np.arange(len(range_m))[:, None], column.shape)
    return csr_array((values[inside], (row[inside], column[inside])), shape=(len(range_m), bins))


def _speed_codes(peaks: Peaks) -> np.ndarray | None:
    """Return the radial speed in the cell of each return, of the loudest in a cell; int16 [range, azimuth]."""
    if peaks.radial_speed_mps is None:
        return None
    grid = SETUP.map_grid
    speed_mps = np.full(grid.shape, np.nan)
    row, column = np.rint(grid.range_index(peaks.range_m)), np.rint(grid.azimuth_index(peaks.azimuth_rad))
    inside = (row < grid.range_bins) & (column >= 0) & (column < grid.azimuth_bins)
    order = np.argsort(peaks.snr_db, kind="stable")
    order = order[inside[order]]
    speed_mps[row[order].astype(np.int64), column[order].astype(np.int64)] = peaks.radial_speed_mps[order]
    return speed_codes(speed_mps)


@lru_cache(maxsize=1)
def _interpolator() -> AzimuthInterpolator:
    return AzimuthInterpolator(SETUP, SETUP.map_grid)


@lru_cache(maxsize=1)
def _noise() -> np.ndarray:
    shape = 2, len(SETUP.beams), SETUP.map_grid.range_bins
    real, imaginary = np.random.default_rng(0).normal(0.0, np.sqrt(0.5), shape)
    return np.asarray(real + 1j * imaginary)
