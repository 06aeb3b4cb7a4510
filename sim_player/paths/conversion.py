"""Conversion of echoes to paths in the radar's frame: weights under the given effects, directions as angles."""

from __future__ import annotations

import math

import numpy as np

from sim_player.effects.table import WEIGHTS
from sim_player.scene.world import Snapshot, World
from sim_player.trace.echoes import Echoes
from sim_player.trace.path_table import Paths


def weights(echoes: Echoes, world: World, effects: frozenset[str]) -> np.ndarray:
    """Return the complex weight of every echo under some weight effects, sqrt(mW)."""
    weight = echoes.weight
    for name, effect in WEIGHTS.items():
        weight = weight * effect.apply(echoes, world, name in effects)
    return np.asarray(weight)


def as_paths(view: Snapshot, echoes: Echoes, effects: frozenset[str]) -> Paths:
    """Return the echoes as paths in the radar's frame: directions as angles, weights under the effects."""
    out_m, back_m = echoes.out_m, echoes.back_m
    if "non_cofocal" in effects and view.world.scene.radar.separation_m > 0.0:
        out_m, back_m = _separated(view, echoes)
    arrive, depart = _to_radar(view, echoes.arrive), _to_radar(view, echoes.depart)
    plan = view.pose.inverse().apply(echoes.point[:, :2])
    return Paths(
        kind=echoes.kind,
        length_m=out_m + back_m,
        radial_speed_mps=echoes.rate_mps,
        azimuth_rad=np.arctan2(arrive[:, 1], arrive[:, 0]),
        elevation_rad=_elevation(arrive),
        departure_azimuth_rad=np.arctan2(depart[:, 1], depart[:, 0]),
        departure_elevation_rad=_elevation(depart),
        amplitude=weights(echoes, view.world, effects),
        order=echoes.order,
        needs=echoes.needs,
        surface=echoes.surface,
        object_index=echoes.object_index,
        chain=echoes.chain,
        point_m=np.column_stack([plan, echoes.point[:, 2] - view.world.radar_height_m]),
        virtual_m=arrive * (0.5 * (echoes.out_m + echoes.back_m))[:, None],
    )


def _separated(view: Snapshot, echoes: Echoes) -> tuple[np.ndarray, np.ndarray]:
    """Return lengths from the transmitting and to the receiving array, half the separation left and right."""
    yaw = view.pose.yaw_rad
    half = 0.5 * view.world.scene.radar.separation_m * np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    # the virtual point stays; the array moves against it
    out = np.linalg.norm(echoes.depart * echoes.out_m[:, None] - half, axis=1)
    back = np.linalg.norm(echoes.arrive * echoes.back_m[:, None] + half, axis=1)
    return out, back


def _to_radar(view: Snapshot, direction: np.ndarray) -> np.ndarray:
    """Return the directions [E, 3] of the scene's frame in the radar's."""
    plan = view.pose.inverse().rotate(direction[:, :2])
    return np.column_stack([plan, direction[:, 2]])


def _elevation(direction: np.ndarray) -> np.ndarray:
    return np.asarray(np.arctan2(direction[:, 2], np.hypot(direction[:, 0], direction[:, 1])))
