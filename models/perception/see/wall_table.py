"""Walls of a scan as one table that compiled code takes plain numbers out of: what they block, how near they are."""

from __future__ import annotations

import numpy as np

from models.compiled import compiled
from models.perception.mirrors.mirror_table import WallArrays

#: Sides of vehicles are poor mirrors and do not surely block.
VEHICLE_LENGTH_M = 5.5
#: The certain part of a wall ends this much before its outermost return; what a wall must be passed by to block.
TRIM_M, CUT_DEPTH_M = 1.0, 1.0
#: No distance from a wall is larger.
FAR_M = 120.0

# Columns of the walls of a scan, an array [W, 12]: compiled code takes plain numbers out of it, since it counts the
# references of every row view that it makes. `CERTAIN` are the ends drawn in; a wall that is `SURE` is long enough to
# block.
ENDS, NORMAL_X, NORMAL_Y, OFFSET, CERTAIN, SURE = 0, 4, 5, 6, 7, 11


def wall_table(walls: WallArrays) -> np.ndarray:
    """Return the table of walls, [W, 12]."""
    sure = walls.length_m > VEHICLE_LENGTH_M
    return np.column_stack([walls.a, walls.b, walls.normal, walls.offset_m, *walls.trimmed(TRIM_M), sure])


@compiled(error_model="numpy")
def cuts(ox, oy, ex, ey, walls, wall, ends):  # type: ignore[no-untyped-def]
    """Return whether a segment crosses a wall between the ends in four columns from `ends` on, not at its start."""
    ax, ay = walls[wall, ends], walls[wall, ends + 1]
    rx, ry, sx, sy = ex - ox, ey - oy, walls[wall, ends + 2] - ax, walls[wall, ends + 3] - ay
    turn = rx * sy - ry * sx
    across = (ax - ox) * ry - (ay - oy) * rx
    # a quotient lies in 0..1 exactly where its parts say so: most walls are passed without a division
    if turn == 0.0 or not abs(across) <= abs(turn) or (across < 0.0 < turn) or (turn < 0.0 < across):
        return False
    along = (ax - ox) * sy - (ay - oy) * sx
    return abs(along) < abs(turn) and along / turn > 1e-9


@compiled
def height_m(x, y, walls, wall):  # type: ignore[no-untyped-def]
    """Return the signed distance of a place from the line of a wall, positive on the radar's side."""
    return x * walls[wall, NORMAL_X] + y * walls[wall, NORMAL_Y] + walls[wall, OFFSET]


@compiled(error_model="numpy")
def blocks(ox, oy, ex, ey, walls, wall):  # type: ignore[no-untyped-def]
    """Return whether a wall surely blocks a segment."""
    if walls[wall, SURE] == 0.0 or not cuts(ox, oy, ex, ey, walls, wall, CERTAIN):
        return False
    return abs(height_m(ex, ey, walls, wall)) > CUT_DEPTH_M


@compiled(error_model="numpy")
def is_free(ox, oy, ex, ey, walls, own):  # type: ignore[no-untyped-def]
    """Return whether no wall other than `own` surely blocks a segment."""
    free, wall = True, 0
    while free and wall < len(walls):
        free = wall == own or not blocks(ox, oy, ex, ey, walls, wall)
        wall += 1
    return free


@compiled(error_model="numpy")
def nearest_wall_m(x, y, walls):  # type: ignore[no-untyped-def]
    """Return the distance of a place from the nearest wall, at most `FAR_M`."""
    nearest, reach2 = FAR_M, np.inf
    for wall in range(len(walls)):
        ax, ay = walls[wall, ENDS], walls[wall, ENDS + 1]
        sx, sy = walls[wall, ENDS + 2] - ax, walls[wall, ENDS + 3] - ay
        share = ((x - ax) * sx + (y - ay) * sy) / max(sx * sx + sy * sy, 1e-12)
        share = min(max(share, 0.0), 1.0)
        dx, dy = x - ax - share * sx, y - ay - share * sy
        # a root is taken only where its square may be the least
        if dx * dx + dy * dy <= reach2:
            nearest = min(nearest, np.hypot(dx, dy))
            reach2 = (1.0 + 1e-9) * (dx * dx + dy * dy)
    return nearest
