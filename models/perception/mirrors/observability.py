"""Observability mask: cells where an object would be detected directly, through the current walls, or not at all.

`MIRRORED`: by the radar equation an object of the stated RCS would exceed the threshold through a wall.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import msgspec
import numpy as np

from models.compiled import compiled
from models.perception.mirrors.mirror_table import wall_arrays
from models.physics.link_budget import beam_snr
from models.physics.mirror import CLEARANCE_M, mirrored, segments_cross
from msgs.values.arrays import require_finite, require_positive
from msgs.values.perception import BevGrid, Visibility, Wall
from msgs.values.radar import RadarSetup
from msgs.values.units import db_from_ratio

# compiled code takes plain numbers
UNKNOWN, DIRECT, MIRRORED = int(Visibility.UNKNOWN), int(Visibility.DIRECT), int(Visibility.MIRRORED)


#: Two-way power loss at a wall, per wall: Fresnel and roughness of a plain facade.
BOUNCE_LOSS_DB = 6.0
#: One-way element half-power beamwidth: cells off boresight are detected more weakly.
ELEMENT_HPBW_DEG = 80.0


class VisibilityParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Assumptions of the mask about object, walls and receiver."""

    rcs_dbsm: float = 10.0
    threshold_db: float = 13.0
    max_range_m: float = 109.0
    azimuth_limit_deg: float = 60.0

    def __post_init__(self) -> None:
        require_finite("visibility", self.rcs_dbsm, self.threshold_db)
        for name in ("max_range_m", "azimuth_limit_deg"):
            require_positive(f"visibility.{name}", getattr(self, name))


def sensitivity_db(setup: RadarSetup) -> float:
    """Return the power over noise [dB] of an isotropic 0 dBsm target at 1 m in a cell of a beam that looks at it."""
    return db_from_ratio(float(beam_snr(setup, 1.0, 1.0)))


#: Sensitivity of a sensor that states none: no cell counts as observed.
UNKNOWN_SENSITIVITY_DB = -1e3


def observability(walls: list[Wall], sensitivity: float, grid: BevGrid, params: VisibilityParams) -> np.ndarray:
    """Return `Visibility` of each cell of the grid, uint8 [rows, columns], through `walls` at a sensitivity in dB."""
    cells_m, lost_db = _field(grid, params)
    level_db = sensitivity + params.rcs_dbsm
    mask = np.where(level_db - lost_db >= params.threshold_db, Visibility.DIRECT, Visibility.UNKNOWN).astype(np.uint8)
    arrays = wall_arrays(walls)
    if len(arrays):
        through = np.concatenate([arrays.a, arrays.b, arrays.normal, arrays.offset_m[:, None]], axis=1)
        _look_past_walls(mask, cells_m, through, _receiver(level_db - BOUNCE_LOSS_DB, params))
    return mask.reshape(grid.rows, grid.columns)


def visibility_at(mask: np.ndarray, grid: BevGrid, points_m: np.ndarray) -> np.ndarray:
    """Return the `Visibility` of points [N, 2] in a mask [rows, columns], unknown off its grid; int64 [N]."""
    column = np.floor((points_m[:, 0] - grid.x_min_m) / grid.cell_m)
    row = np.floor((points_m[:, 1] - grid.y_min_m) / grid.cell_m)
    inside = (row >= 0) & (row < grid.rows) & (column >= 0) & (column < grid.columns)
    states = np.full(len(points_m), UNKNOWN)
    states[inside] = mask[row[inside].astype(int), column[inside].astype(int)]
    return states


@lru_cache(maxsize=2)
def _field(grid: BevGrid, params: VisibilityParams) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres [N, 2] of a grid's cells and the loss [N] of the direct path in dB, common to all scans."""
    cells_m = grid.cell_centres_m().reshape(-1, 2)
    return cells_m, _all_lost_db(cells_m, _receiver(0.0, params))


class _Receiver(NamedTuple):
    """Level in dB of the object at 1 m on boresight and its threshold, and how far and wide the radar looks."""

    level_db: float
    threshold_db: float
    max_range_m: float
    azimuth_limit_deg: float


def _receiver(level_db: float, params: VisibilityParams) -> _Receiver:
    """Return the receiver with all fields of one type, for which the kernels are compiled."""
    limits = (params.threshold_db, params.max_range_m, params.azimuth_limit_deg)
    return _Receiver(float(level_db), *map(float, limits))


@compiled
def _lost_db(x: float, y: float, receiver: _Receiver) -> float:
    """Return the two-way loss to an apparent position relative to 1 m on boresight; infinite outside the field."""
    range_m = math.hypot(x, y)
    if range_m > receiver.max_range_m:
        return math.inf
    azimuth_deg = math.degrees(math.atan2(y, x))
    if abs(azimuth_deg) > receiver.azimuth_limit_deg:
        return math.inf
    # 12 dB (a / hpbw)^2 each way; R^4 of the two-way path
    return 24.0 * (azimuth_deg / ELEMENT_HPBW_DEG) ** 2 + 40.0 * math.log10(max(range_m, 1.0))


@compiled
def _all_lost_db(points_m: np.ndarray, receiver: _Receiver) -> np.ndarray:
    return np.array([_lost_db(points_m[i, 0], points_m[i, 1], receiver) for i in range(len(points_m))])


@compiled(error_model="numpy")
def _look_past_walls(mask: np.ndarray, cells_m: np.ndarray, walls: np.ndarray, receiver: _Receiver) -> None:
    """Clear the direct cells of `mask` [N] that `walls` [W, 7] hide, and mark the cells visible in them."""
    for w in range(len(walls)):
        wall = _wall(walls, w)
        for i in range(len(cells_m)):
            if mask[i] == DIRECT and _is_behind(cells_m[i, 0], cells_m[i, 1], wall):
                mask[i] = UNKNOWN
    for w in range(len(walls)):
        wall = _wall(walls, w)
        # the wall is a window through which the radar's own image looks at the cells
        radar = mirrored(0.0, 0.0, *wall[4:])
        for i in range(len(cells_m)):
            # cells in direct sight stay so, and one mirror is enough
            if mask[i] != UNKNOWN:
                continue
            x, y = cells_m[i, 0], cells_m[i, 1]
            if _height_m(x, y, wall) > 0.0 and _in_wedge(x, y, wall, radar):
                image = mirrored(x, y, *wall[4:])
                # the loss takes an arc tangent and a logarithm: last
                if _is_free(x, y, image, w, walls) and _is_detectable(image, receiver):
                    mask[i] = MIRRORED


@compiled
def _wall(walls, w):  # type: ignore[no-untyped-def]
    """Return a wall's ends, normal and offset as plain numbers: row views are counted in the inner loop."""
    return walls[w, 0], walls[w, 1], walls[w, 2], walls[w, 3], walls[w, 4], walls[w, 5], walls[w, 6]


@compiled
def _height_m(x, y, wall):  # type: ignore[no-untyped-def]
    """Return the distance of a point from a wall's line, positive on the radar's side."""
    return x * wall[4] + y * wall[5] + wall[6]


@compiled
def _is_behind(x, y, wall):  # type: ignore[no-untyped-def]
    """Return whether a wall hides a point from the radar."""
    return _height_m(x, y, wall) < 0.0 and _in_wedge(x, y, wall, (0.0, 0.0))


@compiled
def _in_wedge(x, y, wall, eye):  # type: ignore[no-untyped-def]
    """Return whether the ray from the eye to a point passes between a wall's ends."""
    ax, ay, bx, by = wall[0] - eye[0], wall[1] - eye[1], wall[2] - eye[0], wall[3] - eye[1]
    x, y = x - eye[0], y - eye[1]
    turn = np.sign(ax * by - ay * bx)
    # a wall seen edge-on has no wedge: without a turn every ray would pass
    return turn != 0.0 and turn * (ax * y - ay * x) >= 0.0 and turn * (x * by - y * bx) >= 0.0


@compiled(error_model="numpy")
def _is_free(x, y, image, own, walls):  # type: ignore[no-untyped-def]
    """Return whether no other wall blocks the two segments radar -> specular point -> point of a path by one wall."""
    wall = _wall(walls, own)
    # the height over the wall's line falls from its offset at the radar to -height at the image
    share = wall[6] / (wall[6] + _height_m(x, y, wall))
    at_x, at_y = share * image[0], share * image[1]
    for w in range(len(walls)):
        ends = _wall(walls, w)[:4]
        if w != own and (
            segments_cross(0.0, 0.0, at_x, at_y, *ends, CLEARANCE_M)
            or segments_cross(at_x, at_y, x, y, *ends, CLEARANCE_M)
        ):
            return False
    return True


@compiled
def _is_detectable(image, receiver):  # type: ignore[no-untyped-def]
    """Return whether an echo at an apparent position is over the threshold."""
    return receiver.level_db - _lost_db(image[0], image[1], receiver) >= receiver.threshold_db
