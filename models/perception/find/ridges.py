"""Ridges of a range-azimuth map: cells that are a maximum of their range bin; lobes give azimuth to sub-beam.

A wall seen at an angle is a ridge across many range bins with hardly a maximum of the plane.
"""

from __future__ import annotations

import msgspec
import numpy as np

from models.perception.find.peaks import keep_apart
from msgs.values.arrays import require_within

#: Largest number of cells along either side of a map.
MAX_CELLS = 8192
#: An echo from beyond the map is so much stronger, at most, than its flank at the border: 9 dB at 90 degrees, half the
#: way from one end of a map of 60 degrees to the other through the period of an array of half a wavelength.
BEYOND_DB = 10.0


MAX_RANGE_M = 109.0
AZIMUTH_LOBE_BINS = 3
RANGE_LOBE_BINS = 12


class RidgeParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Spacing and least level of ridge cells, and the limits of the side lobes of stronger ones."""

    #: Cells (range, azimuth) that two peaks are apart in one of the two: the resolution of the map.
    spacing: tuple[int, int] = (2, 10)
    #: Over the map's noise.
    min_snr_db: float = 13.0
    #: Azimuth lobes: weaker by this much within these range bins.
    azimuth_lobe_db: float = 22.0
    #: Range lobes of the Hann window: weaker by this much, this near in range, within a beam.
    range_lobe_db: float = 30.0
    beam_cells: int = 20

    def __post_init__(self) -> None:
        require_within("ridges.spacing", 0, MAX_CELLS, *self.spacing)


def find_ridges(
    power: np.ndarray,
    allowed: np.ndarray,
    noise_power_mw: float,
    range_m: np.ndarray,
    params: RidgeParams,
    has_lobes: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ridge cells [N, 2] among `allowed` cells and their fractional places [N, 2]; highest first.

    Without lobes, and without echoes from beyond the map. `power` [range, azimuth] in milliwatt, `range_m` [range].
    """
    # in float64: noise may be more than float32 holds
    floor = np.float64(noise_power_mw * 10.0 ** (params.min_snr_db / 10.0))
    candidates = allowed & (power > floor) & (range_m <= MAX_RANGE_M)[:, None]
    level_db = 10.0 * np.log10(np.maximum(power, np.finfo(np.float32).tiny))
    cells = ridge_cells(np.where(candidates, level_db, -np.inf), params.spacing)
    outside = beyond_the_map(level_db, cells) if has_lobes else np.zeros(len(cells), bool)
    heard_db = level_db[cells[:, 0], cells[:, 1]] + BEYOND_DB * outside
    cells = cells[~side_lobes(cells, heard_db, params) & ~outside]
    fractional = cells.astype(np.float64)
    fractional[:, 1] = lobe_azimuth(level_db, cells)
    return cells, fractional


def ridge_cells(level_db: np.ndarray, spacing: tuple[int, int]) -> np.ndarray:
    """Return the cells [N, 2], highest first, that top their range bin over `spacing` azimuths to either side."""
    # imported here: pursuit needs no ridges, and a restarted node must not wait for it
    from scipy import ndimage

    top = ndimage.maximum_filter1d(level_db, 2 * spacing[1] + 1, axis=1, mode="constant", cval=-np.inf)
    cells = np.argwhere((level_db >= top) & np.isfinite(level_db))
    cells = cells[np.argsort(-level_db[cells[:, 0], cells[:, 1]], kind="stable")]
    return cells[keep_apart(cells, spacing)]


def lobe_azimuth(level_db: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the fractional azimuth bins [N]: vertex of the parabola through levels three cells to either side."""
    reach = 3
    inner = np.clip(cells[:, 1], reach, level_db.shape[1] - 1 - reach)
    before, here, after = (level_db[cells[:, 0], inner + k] for k in (-reach, 0, reach))
    curvature = before - 2.0 * here + after
    peaked = (inner == cells[:, 1]) & (here >= before) & (here >= after) & (curvature < 0.0)
    shift = 0.5 * reach * (before - after) / np.where(peaked, curvature, -1.0)
    return np.where(peaked, inner + np.clip(shift, -1.0, 1.0), cells[:, 1])


def beyond_the_map(level_db: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return which cells [N, 2] of the outermost azimuths are flanks of lobes further out; bool [N]."""
    reach, last = 3, level_db.shape[1] - 1
    inwards = np.where(cells[:, 1] == 0, reach, -reach)
    here, near, far = (level_db[cells[:, 0], np.clip(cells[:, 1] + k * inwards, 0, last)] for k in range(3))
    # the parabola through the three has its vertex -reach * slope / (2 curvature) cells further out
    slope, curvature = 3.0 * here - 4.0 * near + far, here - 2.0 * near + far
    at_border = (cells[:, 1] == 0) | (cells[:, 1] == last)
    return np.asarray(at_border & (slope > 0.0) & (reach * slope > -curvature))


def side_lobes(cells: np.ndarray, level_db: np.ndarray, params: RidgeParams) -> np.ndarray:
    """Return the peaks that are lobes of a stronger one at their range, or near it within their beam; bool [N]."""
    range_apart = np.abs(cells[:, 0, None] - cells[:, 0])
    azimuth_apart = np.abs(cells[:, 1, None] - cells[:, 1])
    weaker_db = level_db - level_db[:, None]  # [N, N]: how much stronger the other one is
    azimuth_lobe = (range_apart <= AZIMUTH_LOBE_BINS) & (weaker_db >= params.azimuth_lobe_db)
    range_lobe = (
        (range_apart <= RANGE_LOBE_BINS) & (azimuth_apart <= params.beam_cells) & (weaker_db >= params.range_lobe_db)
    )
    return np.logical_or.reduce(azimuth_lobe | range_lobe, axis=1)
