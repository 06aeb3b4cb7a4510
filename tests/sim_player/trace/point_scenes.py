"""Scenes of points that scatter alike to all sides, so that every echo can be worked out by hand."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from msgs.values.radar import RadarParams
from sim_player.effects.table import PATHS
from sim_player.scene.description import Ego, Scene, SceneObject, SceneRadar, Surface, Weather
from sim_player.scene.segments import Occlusion
from sim_player.scene.world import Snapshot, World, prepare, snapshot
from sim_player.trace.echoes import Echoes
from sim_player.trace.effect_names import PATH_EFFECTS
from sim_player.trace.routes import Routes
from sim_player.trace.snapshot import TraceContext

RADAR = RadarParams()
WAVENUMBER = 2.0 * math.pi / RADAR.wavelength_m
Point = tuple[float, float, float]


def wall(*ends: tuple[float, float], material: str = "metal", role: str = "relay", **more: float) -> Surface:
    return Surface(
        role=role,
        material=material,
        polyline_m=tuple((float(x), float(y)) for x, y in ends),
        height_m=more.pop("height_m", 5.0),
        **more,
    )


def points_world(
    points: list[Point],
    *surfaces: Surface,
    motion: list[tuple[float, float]] | None = None,
    radar: SceneRadar | None = None,
    ego: Ego | None = None,
    weather: Weather | None = None,
) -> World:
    """Each point is an object of its own: 1 m^2 from everywhere, phase 0, no body; `motion` its (speed, yaw_deg)."""
    motion = motion or [(0.0, 0.0)] * len(points)
    # the bodies that carry them stand far away
    things = [
        SceneObject(class_="pedestrian", x_m=-600.0 - 3.0 * index, y_m=0.0, speed_mps=speed, yaw_deg=yaw)
        for index, (speed, yaw) in enumerate(motion)
    ]
    scene = Scene(
        name="points",
        surfaces=surfaces,
        objects=tuple(things),
        radar=radar or SceneRadar(),
        ego=ego or Ego(),
        weather=weather or Weather(),
    )
    count, sides = len(points), np.array([[0.5, 0.8, 0.3], [-0.5, -0.8, -0.3]])
    return dataclasses.replace(
        prepare(scene),
        centre_m=np.array(points, np.float64).reshape(-1, 3),
        centre_normals=np.tile(sides, (count, 1, 1)),
        centre_rcs_m2=np.ones(count),
        centre_phase_rad=np.zeros(count),
        centre_exponent=np.zeros(count),
        centre_floor=np.full(count, 0.1),
        centre_object=np.arange(count),
    )


class Traced(NamedTuple):
    view: Snapshot
    routes: dict[str, Routes]
    straight: tuple[Routes, Occlusion]
    echoes: dict[str, Echoes]


def traced(world: World, *names: str, time_s: float = 0.0) -> Traced:
    """The effects asked for, in their order, with their routes and echoes."""
    tracing, echoes = TraceContext(snapshot(world, time_s)), {}
    for name in PATH_EFFECTS:
        if name in names:
            assert PATHS[name].absent(world) is None
            echoes[name] = PATHS[name].apply(tracing)
    return Traced(tracing.view, tracing.routes, tracing.straight, echoes)


def unit_weight(echoes: Echoes) -> np.ndarray:
    """Complex weights over that of 1 m^2 at 1 m: factors over lengths, without the phase of the length."""
    power_mw = 1e3 * RADAR.transmit_power_w * RADAR.wavelength_m**2 / (4.0 * math.pi) ** 3
    weight = echoes.weight * echoes.whole * echoes.rough * echoes.foliage
    return np.asarray(weight / math.sqrt(power_mw))


def one_way_field(routes: Routes) -> np.ndarray:
    """Complex field of routes at their targets, for a unit point source e^{-jkr} / r at the antenna."""
    factor = routes.whole * routes.rough * routes.foliage * routes.other
    return np.asarray(factor * np.exp(-1j * WAVENUMBER * routes.length_m) / routes.length_m)
