"""Walls that mirror, told by what they show: a mirror repeats what stands before it in plain sight.

The direct returns before a wall say where their images would be. On a mirror many of these places hold an image; on a
row of cars, a fence or a hedge the returns behind are what stands there, and meet the places by chance. Chance is
measured on the same places, moved along the wall.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from models.perception.mirrors.image_walls import DirectReturns
from models.perception.mirrors.mirror_table import RADAR
from models.physics.mirror import crosses, reflect
from msgs.values.perception import Wall

#: An image this near its place is there.
REACH_M = 1.0
#: Share of places that hold an image, less that of the moved ones: 0.04 in the median on real streets, 0.37 of walls
#: that show a hidden object in simulated ones.
MIN_EXCESS = 0.12
#: Fewer places say nothing.
MIN_PLACES = 5
#: Moves along the wall, longer than a car.
MOVES_M = (-12.0, -9.0, -6.0, 6.0, 9.0, 12.0)


def shows_what_is_before(
    walls: list[Wall], returns: DirectReturns, images_m: np.ndarray, max_range_m: float
) -> np.ndarray:
    """Return which walls repeat the direct returns before them among the images [N, 2], or have too few to tell; bool
    [W].
    """
    tree = cKDTree(images_m) if len(images_m) else None
    result = np.ones(len(walls), bool)
    for index, wall in enumerate(walls):
        normal, ends_m = np.array(wall.normal), np.array(wall.ends_m)
        others_m = returns.points_m[returns.wall != index]
        before_m = others_m[others_m @ normal + wall.offset_m > REACH_M]
        places_m = reflect(before_m, normal, wall.offset_m)
        visible = crosses(RADAR, places_m, ends_m[:1], ends_m[1:])[:, 0] & (np.hypot(*places_m.T) < max_range_m)
        if visible.sum() >= MIN_PLACES and tree is not None:
            along = np.array([-normal[1], normal[0]])
            moved_m = places_m[visible] + np.array((0.0, *MOVES_M))[:, None, None] * along
            held = np.isfinite(tree.query(moved_m, distance_upper_bound=REACH_M)[0]).mean(axis=1)
            result[index] = held[0] - held[1:].mean() >= MIN_EXCESS
    return result
