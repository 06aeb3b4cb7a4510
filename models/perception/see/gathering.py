"""Evidence of hidden objects in the bird's-eye view: what the map shows of a place by each mirror that could show it.

A place is reflected in a wall; level, contrast, shadow and heats at the image speak for or against an object. The
likeliest mirrors of a place stand side by side, and over all of them what they agree and disagree on.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from scipy.ndimage import uniform_filter

from models.compiled import compiled
from models.perception.mirrors.mirror_table import WallArrays
from models.perception.see.wall_table import ENDS, NORMAL_X, NORMAL_Y, OFFSET, SURE, is_free, nearest_wall_m, wall_table
from msgs.values.arrays import require_positive
from msgs.values.radar import RangeAzimuthMap

#: What the map and the walls say of a place by one mirror, in order.
BY_MIRROR = (
    "valid", "level", "contrast", "shadow", "direct", "mirrored", "incidence", "missed", "first_leg_free",
    "second_leg_free", "length", "angle_std", "gap", "toward_x", "toward_y", "range", "sure", "certainty",
)  # fmt: skip
#: Over all mirrors with free legs.
OVER_MIRRORS = ("count", "mean_level", "least_contrast", "most_mirrored", "sum_mirrored", "second_mirrored")
#: Of the place itself.
OF_PLACE = ("in_view", "is_hidden", "level", "contrast", "direct", "mirrored", "to_wall", "x", "y", "range")
#: Levels of a map over its noise, and contrasts, that count as 0 and 1 [dB].
LEVEL_DB, CONTRAST_DB = (-5.0, 85.0), 40.0
#: Cells about one that are looked at, and those that are its surroundings: range bins, azimuths.
NEAR_CELLS, AROUND_CELLS = (3, 5), (17, 17)
#: Least depth of an image behind its wall; places nearer to the end of their way are on the wall.
MIN_DEPTH_M = 0.7
#: Two walls that show a place so near to each other are one mirror.
SAME_IMAGE_M = 0.7
#: Directions are known this well; a wall may reach beyond its ends by twice as much, and this much more.
AZIMUTH_STD_RAD, END_M, MAX_MISSED_M = 0.035, 0.5, 8.0
#: Bounds of distances, lengths and errors in channels.
FAR_M, GAP_M, RANGE_M, PLACE_M, ANGLE_RAD = 8.0, 8.0, 70.0, 42.0, 0.175
GAP_STEP_M, GAPS = 0.5, 256


class BirdsEyeGrid(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Cells of the plane about the radar: x ahead, y to the left."""

    x_min_m: float = 2.0
    x_max_m: float = 42.0
    y_limit_m: float = 28.0
    cell_m: float = 0.5

    def __post_init__(self) -> None:
        require_positive("grid.cell_m", self.cell_m)
        require_positive("grid.y_limit_m", self.y_limit_m)
        require_positive("grid.x_max_m - grid.x_min_m", self.x_max_m - self.x_min_m)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows along x, columns along y."""
        return round((self.x_max_m - self.x_min_m) / self.cell_m), 2 * round(self.y_limit_m / self.cell_m)

    @property
    def x_m(self) -> np.ndarray:
        """Centres of the rows."""
        return self.x_min_m + self.cell_m * (np.arange(self.shape[0]) + 0.5)

    @property
    def y_m(self) -> np.ndarray:
        """Centres of the columns."""
        return -self.y_limit_m + self.cell_m * (np.arange(self.shape[1]) + 0.5)


@dataclass(frozen=True)
class Evidence:
    """Channels float32 [channels, x, y], and the likeliest mirror of each place, int16 [x, y] (-1: none)."""

    channels: np.ndarray
    mirror: np.ndarray


def channel_names(mirrors: int) -> list[str]:
    """Return the names of the channels of evidence by so many mirrors, in order."""
    by_mirror = [f"{name}_{k}" for k in range(mirrors) for name in BY_MIRROR]
    return [*by_mirror, *OVER_MIRRORS, *OF_PLACE]


def odd_channels(mirrors: int) -> list[int]:
    """Return the channels that change sign when left and right are exchanged."""
    names = channel_names(mirrors)
    return [index for index, name in enumerate(names) if name == "y" or name.startswith("toward_y_")]


def map_fields(ra_map: RangeAzimuthMap, heat: np.ndarray) -> np.ndarray:
    """Return level, contrast, shadow and both heats of the nearest bins, float32 [5, range, azimuth], of a map."""
    bins = heat.shape[1]
    values = ra_map.values[:bins]
    power_mw = values.real.astype(np.float32) ** 2 + values.imag.astype(np.float32) ** 2
    level_db = 10.0 * np.log10(np.maximum(power_mw / np.float32(ra_map.noise_power_mw), 1e-3))
    loudest_db = loudest_near(level_db, NEAR_CELLS)
    contrast = np.clip((loudest_db - uniform_filter(level_db, size=AROUND_CELLS, mode="nearest")) / CONTRAST_DB, -1, 1)
    low, high = LEVEL_DB
    level = np.clip((level_db - low) / (high - low), 0.0, 1.0)
    shadow = np.zeros_like(level)
    np.maximum.accumulate(level[:-1], axis=0, out=shadow[1:])
    loudest = np.clip((loudest_db - low) / (high - low), 0.0, 1.0)
    return np.stack([loudest, contrast, shadow, *loudest_near(heat, NEAR_CELLS)]).astype(np.float32, copy=False)


def loudest_near(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the largest value within a window of odd `size` about each cell of [..., range, azimuth], by shifts."""
    for axis, width in zip((-2, -1), size, strict=True):
        near, moved = values.copy(), np.moveaxis(values, axis, 0)
        largest = np.moveaxis(near, axis, 0)
        for shift in range(1, width // 2 + 1):
            np.maximum(largest[shift:], moved[:-shift], out=largest[shift:])
            np.maximum(largest[:-shift], moved[shift:], out=largest[:-shift])
        values = near
    return values


def gathered(
    grid: BirdsEyeGrid,
    ra_map: RangeAzimuthMap,
    heat: np.ndarray,
    walls: WallArrays,
    certainty: np.ndarray,
    support_m: np.ndarray,
    wall_of: np.ndarray,
    mirrors: int,
) -> Evidence:
    """Return the evidence of a map by its walls, of `certainty` [walls] in 0..1.

    `support_m` [N, 2]: places where walls were seen, each of a wall `wall_of` [N] (-1: none).
    """
    channels = np.zeros((len(channel_names(mirrors)), *grid.shape), np.float32)
    mirror = np.full(grid.shape, -1, np.int16)
    first = ra_map.grid.range_at(np.arange(2)), ra_map.grid.azimuth_at(np.arange(2))
    steps = tuple(float(value) for pair in first for value in (pair[0], pair[1] - pair[0]))
    table = _table(walls, certainty)
    gaps = _gaps(walls, support_m, wall_of)
    _gather(grid.x_m, grid.y_m, table, gaps, map_fields(ra_map, heat), steps, mirrors, grid.y_limit_m, channels, mirror)
    return Evidence(channels, mirror)


# Columns of the table of walls beyond those of `wall_table`: length, curvature, error of its direction, certainty.
_LENGTH, _CURVE, _ANGLE, _TRUST = range(12, 16)


def _table(walls: WallArrays, certainty: np.ndarray) -> np.ndarray:
    further = walls.length_m, walls.curvature_per_m, walls.angle_std_rad, certainty
    return np.column_stack([wall_table(walls), *further])


def _gaps(walls: WallArrays, support_m: np.ndarray, wall_of: np.ndarray) -> np.ndarray:
    """Return the distance along each wall to the nearest place where it was seen, [walls, GAPS] about its middle."""
    gaps = np.full((len(walls), GAPS), GAP_M)
    from_middle_m = GAP_STEP_M * (np.arange(GAPS) + 0.5 - 0.5 * GAPS)
    for wall in range(len(walls)):
        own = support_m[wall_of == wall]
        if len(own):
            chord = (walls.b[wall] - walls.a[wall]) / max(walls.length_m[wall], 1e-9)
            along_m = np.sort((own - walls.a[wall]) @ chord)
            at_m = from_middle_m + 0.5 * walls.length_m[wall]
            right = np.clip(np.searchsorted(along_m, at_m), 1, max(len(along_m) - 1, 1))
            left_m, right_m = along_m[right - 1], along_m[np.minimum(right, len(along_m) - 1)]
            gaps[wall] = np.minimum(np.minimum(np.abs(at_m - left_m), np.abs(at_m - right_m)), GAP_M)
    return gaps


@compiled(error_model="numpy")
def _mirror_at(x, y, table, wall):  # type: ignore[no-untyped-def]
    """Return whether a place has an image in a wall, the image, the mirror, the place along the wall, its normal."""
    nx, ny, offset = table[wall, NORMAL_X], table[wall, NORMAL_Y], table[wall, OFFSET]
    ax, ay, length = table[wall, ENDS], table[wall, ENDS + 1], table[wall, _LENGTH]
    ux, uy = (table[wall, ENDS + 2] - ax) / length, (table[wall, ENDS + 3] - ay) / length
    normal_x, normal_y, curve = nx, ny, table[wall, _CURVE]
    ix, iy, mx, my, along = 0.0, 0.0, 0.0, 0.0, 0.0
    # an arc mirrors as its tangent where the ray meets it, which is found by a few steps from the chord
    for _ in range(1 if curve == 0.0 else 4):
        height = x * nx + y * ny + offset
        if height < MIN_DEPTH_M or offset <= 0.0:
            return False, ix, iy, mx, my, along, nx, ny
        ix, iy = x - 2.0 * height * nx, y - 2.0 * height * ny
        share = offset / (offset + height)
        mx, my = share * ix, share * iy
        along = (mx - ax) * ux + (my - ay) * uy
        if curve != 0.0:
            t = min(max(along, -2.0), length + 2.0) - 0.5 * length
            sag = 0.5 * curve * (0.25 * length * length - t * t)
            qx, qy = ax + (0.5 * length + t) * ux - sag * normal_x, ay + (0.5 * length + t) * uy - sag * normal_y
            nx, ny = normal_x - curve * t * ux, normal_y - curve * t * uy
            size = np.hypot(nx, ny)
            nx, ny = nx / size, ny / size
            offset = -(nx * qx + ny * qy)
    return True, ix, iy, mx, my, along, nx, ny


@compiled(error_model="numpy")
def _gather(xs, ys, table, gaps, fields, steps, mirrors, y_limit, channels, mirror):  # type: ignore[no-untyped-def]
    """Write the channels and the likeliest mirror of every place."""
    range_first, range_step, azimuth_first, azimuth_step = steps
    bins, azimuths = fields.shape[1], fields.shape[2]
    walls, each = len(table), len(BY_MIRROR)
    features, key, of = np.zeros((max(walls, 1), each)), np.zeros(max(walls, 1)), np.zeros(max(walls, 1), np.int64)
    image = np.zeros((max(walls, 1), 2))
    over = mirrors * each
    place = over + len(OVER_MIRRORS)
    for i in range(len(xs)):
        for j in range(len(ys)):
            x, y = xs[i], ys[j]
            count, free, level_sum, least_contrast, most, second, heat_sum = 0, 0, 0.0, 1.0, 0.0, 0.0, 0.0
            for wall in range(walls):
                has, ix, iy, mx, my, along, nx, ny = _mirror_at(x, y, table, wall)
                if not has:
                    continue
                # what is cheap to ask comes first: most walls show no image of a place
                missed = max(max(-along, along - table[wall, _LENGTH]), 0.0)
                if missed > MAX_MISSED_M:
                    continue
                away = np.sqrt(ix * ix + iy * iy)
                row = (away - range_first) / range_step
                if row < 1.0 or row >= bins - 1:
                    continue
                incidence = abs(ix * nx + iy * ny) / away
                sideways = np.sqrt(mx * mx + my * my) * AZIMUTH_STD_RAD / max(incidence, 0.1)
                if missed > END_M + 2.0 * sideways:
                    continue
                column = (np.arctan2(iy, ix) - azimuth_first) / azimuth_step
                if column < 0.0 or column > azimuths - 1:
                    continue
                first_free = is_free(0.0, 0.0, mx, my, table, wall)
                second_free = is_free(mx, my, x, y, table, wall)
                r, c = int(row + 0.5), int(column + 0.5)
                level, contrast, heat = fields[0, r, c], fields[1, r, c], fields[4, r, c]
                dx, dy = x - mx, y - my
                away_m = max(np.sqrt(dx * dx + dy * dy), 1e-6)
                from_middle = along - 0.5 * table[wall, _LENGTH]
                gap = gaps[wall, min(max(int(from_middle / GAP_STEP_M + 0.5 * GAPS), 0), GAPS - 1)]
                f = features[count]
                f[0], f[1], f[2], f[3], f[4], f[5] = 1.0, level, contrast, fields[2, r, c], fields[3, r, c], heat
                f[6], f[7] = incidence, missed / MAX_MISSED_M
                f[8], f[9] = 1.0 if first_free else 0.0, 1.0 if second_free else 0.0
                f[10] = min(np.log(max(table[wall, _LENGTH], 1.0)) / 4.0, 1.0)
                f[11], f[12] = min(table[wall, _ANGLE] / ANGLE_RAD, 1.0), gap / GAP_M
                f[13], f[14], f[15] = dx / away_m, dy / away_m, min(away / RANGE_M, 1.0)
                f[16], f[17] = table[wall, SURE], table[wall, _TRUST]
                both = first_free and second_free
                key[count] = heat + 0.5 * contrast + (1.0 if both else 0.0) + (0.3 if missed == 0.0 else 0.0)
                key[count] += 0.1 * table[wall, SURE]
                of[count] = wall
                image[count, 0], image[count, 1] = ix, iy
                count += 1
            for k in range(count):
                best = 0
                for other in range(1, count):
                    best = other if key[other] > key[best] else best
                if key[best] == -np.inf:
                    break
                f = features[best]
                if k == 0:
                    mirror[i, j] = of[best]
                if k < mirrors:
                    for q in range(each):
                        channels[k * each + q, i, j] = f[q]
                if f[8] > 0.0 and f[9] > 0.0:
                    free, level_sum, heat_sum = free + 1, level_sum + f[1], heat_sum + f[5]
                    least_contrast = min(least_contrast, f[2])
                    second, most = (most, f[5]) if f[5] > most else (max(second, f[5]), most)
                # walls that show the place at one image are one mirror
                for other in range(count):
                    apart_x, apart_y = image[other, 0] - image[best, 0], image[other, 1] - image[best, 1]
                    if apart_x * apart_x + apart_y * apart_y < SAME_IMAGE_M**2:
                        key[other] = -np.inf
            channels[over, i, j] = min(free / 4.0, 1.0)
            if free > 0:
                channels[over + 1, i, j], channels[over + 2, i, j] = level_sum / free, least_contrast
                channels[over + 3, i, j], channels[over + 4, i, j] = most, min(heat_sum / 2.0, 1.0)
                channels[over + 5, i, j] = second
            away = np.sqrt(x * x + y * y)
            row = (away - range_first) / range_step
            column = (np.arctan2(y, x) - azimuth_first) / azimuth_step
            if 0.0 <= column <= azimuths - 1 and row < bins - 1:
                r, c = int(row + 0.5), int(column + 0.5)
                channels[place, i, j] = 1.0
                channels[place + 2, i, j], channels[place + 3, i, j] = fields[0, r, c], fields[1, r, c]
                channels[place + 4, i, j], channels[place + 5, i, j] = fields[3, r, c], fields[4, r, c]
            channels[place + 1, i, j] = 0.0 if is_free(0.0, 0.0, x, y, table, -1) else 1.0
            channels[place + 6, i, j] = min(nearest_wall_m(x, y, table), FAR_M) / FAR_M
            channels[place + 7, i, j], channels[place + 8, i, j] = x / PLACE_M, y / y_limit
            channels[place + 9, i, j] = min(away / 50.0, 1.0)
