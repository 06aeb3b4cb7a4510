"""Paths of the tracer: echoes of one instant, each with its length, directions and complex weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msgs.values.array_table import ArrayTable


@dataclass(frozen=True)
class Paths(ArrayTable):
    """P paths of one instant; points in the radar's frame (z above the antenna) in metres."""

    #: `PathClass` values, uint8 [P].
    kind: np.ndarray
    #: Round trip, and half its rate of change (the radial speed of the virtual point).
    length_m: np.ndarray
    radial_speed_mps: np.ndarray
    #: Direction of arrival at the radar.
    azimuth_rad: np.ndarray
    elevation_rad: np.ndarray
    #: Direction of departure; differs from the arrival where the return route differs from the outbound one.
    departure_azimuth_rad: np.ndarray
    departure_elevation_rad: np.ndarray
    #: Complex field weight without the antenna, transmit power included, in sqrt(mW).
    amplitude: np.ndarray
    #: Bounces at walls on the outbound and on the return route, the larger of the two; uint8.
    order: np.ndarray
    #: Bit of every effect without which the path would not be there (`sim_player.trace.effect_names`), uint32.
    needs: np.ndarray
    #: Piece of wall that returned or first mirrored it (index into `World.wall_a`), -1 for none; int32.
    surface: np.ndarray
    #: Object it comes from, -1 for none; int32.
    object_index: np.ndarray
    #: The same number for the same scatterer by the same routes at another time, uint64.
    chain: np.ndarray
    #: True and apparent position of the scatterer: [P, 3].
    point_m: np.ndarray
    virtual_m: np.ndarray
