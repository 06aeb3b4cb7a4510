"""Where an object would have been seen: in direct sight, or through today's walls, or not at all.

"Nothing hidden" is not "cannot see": a cell is `MIRRORED` only if an object of the stated RCS standing there would
have risen over the detection threshold through one of the walls, by the radar equation; else it is unknown.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from models.perception.mirrors import RADAR, WallArrays, wall_arrays
from models.physics.antenna import row_field
from models.physics.mirror import blocked, reflect
from models.physics.waveform import window_noise_gain
from msgs.arrays import require_finite, require_positive
from msgs.frames import polar_from_xy
from msgs.perception import BevGrid, Visibility, Wall
from msgs.radar import RadarSetup
from msgs.units import db_from_ratio


class VisibilityParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the mask assumes of object, walls and receiver."""

    rcs_dbsm: float = 10.0
    #: Power lost at a wall there and back, per wall: Fresnel and roughness of a plain facade.
    bounce_loss_db: float = 6.0
    threshold_db: float = 13.0
    max_range_m: float = 109.0
    azimuth_limit_deg: float = 60.0
    #: One-way element half-power beamwidth: cells off boresight are seen weaker.
    element_hpbw_deg: float = 80.0

    def __post_init__(self) -> None:
        require_finite("visibility", self.rcs_dbsm, self.bounce_loss_db, self.threshold_db)
        for name in ("max_range_m", "azimuth_limit_deg", "element_hpbw_deg"):
            require_positive(f"visibility.{name}", getattr(self, name))


def sensitivity_db(setup: RadarSetup) -> float:
    """Power over noise, in one cell of a beam that looks at it, of an isotropic 0 dBsm target at 1 m, in dB.

    Radar equation P G^2 lambda^2 / (4 pi)^3 against k T0 f_s F spread over all samples of the beam (coherent over
    its chirps), with the noise gain of the Hann window.
    """
    radar, array = setup.radar, setup.array
    rows = float(np.square(row_field(array, radar.wavelength_m, np.zeros(1))[0]))
    gain = rows * array.columns * 10.0 ** (setup.element.peak_gain_dbi / 10.0)
    received_mw = 1e3 * radar.transmit_power_w * gain**2 * radar.wavelength_m**2 / (4.0 * math.pi) ** 3
    samples = radar.samples_per_chirp * radar.chirps_per_beam
    return db_from_ratio(received_mw / (radar.noise_power_mw * window_noise_gain("hann") / samples))


def observability(walls: list[Wall], sensitivity: float, grid: BevGrid, params: VisibilityParams) -> np.ndarray:
    """`Visibility` of each cell of the grid, uint8 [rows, columns], through `walls` at a sensitivity in dB."""
    cells_m = grid.cell_centres_m().reshape(-1, 2)
    arrays = wall_arrays(walls)
    mask = np.full(len(cells_m), Visibility.UNKNOWN, np.uint8)
    direct = _detectable(cells_m, sensitivity + params.rcs_dbsm, params)
    for index in range(len(walls)):
        mask[_seen_in_mirror(cells_m, index, arrays, sensitivity, params)] = Visibility.MIRRORED
        behind = cells_m @ arrays.normal[index] + arrays.offset_m[index] < 0.0
        direct &= ~(behind & _in_wedge(cells_m, arrays.a[index], arrays.b[index]))
    mask[direct] = Visibility.DIRECT
    return mask.reshape(grid.rows, grid.columns)


def _in_wedge(points_m: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Points [N, 2] whose ray from the origin passes between a and b [2]; bool [N]."""
    turn = np.sign(a[0] * b[1] - a[1] * b[0])
    past_a = turn * (points_m @ np.array([-a[1], a[0]])) >= 0.0
    return past_a & (turn * (points_m @ np.array([b[1], -b[0]])) >= 0.0)


def _detectable(images_m: np.ndarray, level_db: float, params: VisibilityParams) -> np.ndarray:
    """Whether something of `level_db` at 1 m on boresight is over the threshold at these apparent places; bool [N]."""
    range_m, azimuth_rad = polar_from_xy(images_m)
    azimuth_deg = np.degrees(azimuth_rad)
    # 12 dB (a / hpbw)^2 each way; R^4 of the two-way path
    lost_db = 24.0 * (azimuth_deg / params.element_hpbw_deg) ** 2 + 40.0 * np.log10(np.maximum(range_m, 1.0))
    in_field = (np.abs(azimuth_deg) <= params.azimuth_limit_deg) & (range_m <= params.max_range_m)
    return in_field & (level_db - lost_db >= params.threshold_db)


def _seen_in_mirror(
    cells_m: np.ndarray, index: int, walls: WallArrays, sensitivity: float, params: VisibilityParams
) -> np.ndarray:
    """Indices of the cells an object of the stated RCS would be detected in, through one wall."""
    normal, offset_m = walls.normal[index], float(walls.offset_m[index])
    # the wall is a window through which the radar's own image looks at the cells
    radar_image = reflect(RADAR, normal, offset_m)
    window = _in_wedge(cells_m - radar_image, walls.a[index] - radar_image, walls.b[index] - radar_image)
    cells = np.flatnonzero(window & (cells_m @ normal + offset_m > 0.0))
    images_m = reflect(cells_m[cells], normal, offset_m)
    seen = _detectable(images_m, sensitivity + params.rcs_dbsm - params.bounce_loss_db, params)
    images_m, cells = images_m[seen], cells[seen]
    # the height over the wall's line falls from offset_m at the radar to -height at the image
    height_m = cells_m[cells] @ normal + offset_m
    mirror_m = images_m * (offset_m / (offset_m + height_m))[:, None]
    others = walls.select(np.arange(len(walls)) != index)
    cut = blocked(RADAR, mirror_m, others.a, others.b) | blocked(mirror_m, cells_m[cells], others.a, others.b)
    return cells[~cut]
