"""Echoes of rain, snow and fog in the volume of the beam, over the ground, before walls and behind them.

The radar equation of a volume: a cell of range sends back P lambda^2 eta / ((4 pi)^3 R^2) times the integral of the
two-way power pattern over the solid angle that is free (Skolnik, Introduction to Radar Systems, Eq. 13.12), less what
the air takes both ways. The ground, where a scene names one, ends what lies below it. A wall ends the volume under its
top; what it mirrors and lets through goes on behind it, with the fourth power of its field factor, up to the next wall.
Bodies end it too. Left out: drops by way of the ground or of a second mirror, those out by one way and back by another,
curvature (a wall's chord counts), and what lies nearer than `NEAREST_M`, in the near field of the array.
"""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled
from models.physics.antenna import element_field, row_field
from models.physics.precipitation import reflectivity_per_m
from msgs.values.radar import RadarSetup
from sim_player.scene.air import air_db_per_m
from sim_player.scene.world import Snapshot
from sim_player.signal.clutter import CELLS, Clutter, cell_range_m, direction_sines
from sim_player.signal.switches import SignalEffects, isotropic

NEAREST_M = 1.0
#: Elevations of the integral, closer near the horizon, where ground and walls end the beam; azimuths of rays in plan.
ELEVATIONS = 64
RAYS = 360
#: Rays start so far behind a wall that they have met.
STEP_M = 1e-6


def clutter_at(view: Snapshot, effects: SignalEffects) -> Clutter:
    """Return the mean echoes of the air around the radar of a snapshot; the last one is kept with its world."""
    kept = view.world.kept.get("clutter")
    if kept is None or kept[0] is not view or kept[1] != effects.element_pattern:
        kept = view, effects.element_pattern, _clutter(view, effects)
        view.world.kept["clutter"] = kept
    clutter: Clutter = kept[2]
    return clutter


def _clutter(view: Snapshot, effects: SignalEffects) -> Clutter:
    world = view.world
    setup = world.setup if effects.element_pattern else isotropic(world.setup)
    weather, params = world.scene.weather, world.radar
    eta = reflectivity_per_m(params.carrier_hz, weather.rain_mm_per_h, weather.snow_mm_per_h, weather.fog_g_per_m3)
    range_m = cell_range_m(params)
    step_m = range_m[1]
    constant = 1e3 * params.transmit_power_w * params.wavelength_m**2 * eta * step_m / (4.0 * math.pi) ** 3
    loss = 10.0 ** (-0.2 * air_db_per_m(world) * range_m)
    per_cell = np.where(range_m >= NEAREST_M, constant * loss / np.maximum(range_m, NEAREST_M) ** 2, 0.0)
    velocity_mps = view.pose.inverse().rotate(view.radar_velocity)
    return Clutter(_solid_angle(view, setup, step_m) * per_cell, -velocity_mps)


def _solid_angle(view: Snapshot, setup: RadarSetup, step_m: float) -> np.ndarray:
    """Return the solid angle that is free times the power pattern of elements and rows, [directions, CELLS]."""
    name = f"clutter weights of {setup.element}"
    if name not in view.world.kept:
        view.world.kept[name] = _weights(setup)
    elevation_rad, weight, ray = view.world.kept[name]
    change = np.zeros((len(weight), CELLS + 1))
    for gain, first_m, last_m in _free_stretches(view, elevation_rad):
        _add_stretch(change, weight, ray, gain, first_m, last_m, step_m)
    return np.asarray(_filled(change))


def _weights(setup: RadarSetup) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return elevations [E], and for each direction solid angle times power pattern, and ray; [directions, E]."""
    sines = direction_sines(setup)
    edges = np.linspace(-1.0, 1.0, ELEVATIONS + 1)
    edges = 0.5 * math.pi * edges * np.abs(edges)
    elevation_rad, height_rad = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    across = sines[:, None] / np.cos(elevation_rad)
    is_real = np.abs(across) < 1.0
    azimuth_rad = np.arcsin(np.where(is_real, across, 0.0))
    rows = row_field(setup.array, setup.radar.wavelength_m, elevation_rad) ** setup.array.steered_ways
    field = element_field(setup.element, azimuth_rad, elevation_rad) ** 2 * rows
    # d azimuth d elevation cos(elevation) = d sine d elevation / cos(azimuth)
    weight = np.where(is_real, field**2 * (2.0 / len(sines)) * height_rad / np.cos(azimuth_rad), 0.0)
    return elevation_rad, weight, np.clip(((azimuth_rad / math.pi + 0.5) * RAYS).astype(int), 0, RAYS - 1)


@compiled(error_model="numpy")
def _add_stretch(change, weight, ray, gain, first_m, last_m, step_m):  # type: ignore[no-untyped-def]
    """Add what a stretch begins and ends with to each cell; change [directions, CELLS + 1]."""
    cells = change.shape[1] - 1
    here, onward = np.empty(cells + 1), np.empty(cells + 1)
    for n in range(len(weight)):
        for end in range(2):
            here[:], onward[:] = 0.0, 0.0
            for e in range(weight.shape[1]):
                r = ray[n, e]
                share = weight[n, e] * gain[r, e]
                end_m = first_m[r, e]
                if end == 1:
                    share, end_m = -share, max(end_m, last_m[r, e])
                # a cell on the border counts by the share of it that is free
                place = min(end_m / step_m + 0.5, float(cells))
                cell = min(int(place), cells - 1)
                part = share * (place - cell)
                here[cell] += share - part
                onward[cell + 1] += part
            for cell in range(cells + 1):
                change[n, cell] += here[cell]
            for cell in range(cells + 1):
                change[n, cell] += onward[cell]


def _free_stretches(view: Snapshot, elevation_rad: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return stretches of range that hold drops, in sight, in a wall, behind it: gain, first, last [RAYS, E]."""
    world, slope = view.world, np.tan(elevation_rad)
    height_m, walls = world.radar_height_m, len(world.wall_a)
    azimuth_rad = view.pose.yaw_rad + ((np.arange(RAYS) + 0.5) / RAYS - 0.5) * math.pi
    direction = np.column_stack([np.cos(azimuth_rad), np.sin(azimuth_rad)])
    origin = np.broadcast_to(view.origin, direction.shape)
    # a scene that names no ground has none
    down = np.minimum(slope, -1e-300) if world.ground is not None else -1e-300
    ground_m = height_m / -down
    slant = 1.0 / np.cos(elevation_rad)
    distance_m = _distances(view, origin, direction)
    free_m = np.minimum(_free_m(view, distance_m, np.zeros(RAYS), slope), ground_m)
    stretches = [(np.ones(free_m.shape), np.zeros(free_m.shape), free_m * slant)]
    high = np.where(view.blockers.height_m > height_m, distance_m, np.inf)
    if not walls or not np.isfinite(high[:, :walls]).any():
        return stretches
    wall, met_m = high[:, :walls].argmin(axis=1), high[:, :walls].min(axis=1)
    # what stands before it hides its mirror image too
    meets = np.isfinite(met_m) & (met_m == high.min(axis=1))
    met = np.where(meets, met_m, 0.0)
    normal = world.wall_frames[0][wall]
    cosine = np.einsum("ri,ri->r", direction, normal)
    reflected = np.abs(world.reflection(wall, np.abs(cosine))[0]) ** 4 * (meets & world.is_mirror[wall])
    table = np.abs(world.transmission[world.wall_build[wall]])
    cell = np.abs(cosine) * (table.shape[1] - 1)
    through = table[np.arange(RAYS), np.rint(cell).astype(int)] ** 4 * meets
    point = origin + met[:, None] * direction
    for gain, onward in ((reflected, direction - 2.0 * cosine[:, None] * normal), (through, direction)):
        if not gain.any():
            continue
        beyond_m = _distances(view, point + STEP_M * onward, onward, wall)
        last_m = np.minimum(_free_m(view, beyond_m, met, slope) + met[:, None], ground_m)
        # over the wall's top and before it the direct volume counts
        behind = (free_m == met_m[:, None]) * gain[:, None]
        stretches.append((behind, np.broadcast_to(met[:, None] * slant, behind.shape), last_m * slant))
    return stretches


def _distances(
    view: Snapshot, origin: np.ndarray, direction: np.ndarray, skipped: np.ndarray | None = None
) -> np.ndarray:
    """Return how far along rays in plan [R, 2] walls and sides of bodies stand, infinite where a ray misses; [R, W]."""
    along = view.blockers.b - view.blockers.a
    from_ray = view.blockers.a[None] - origin[:, None]
    turn = direction[:, :1] * along[:, 1] - direction[:, 1:] * along[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead_m = (from_ray[..., 0] * along[:, 1] - from_ray[..., 1] * along[:, 0]) / turn
        share = (from_ray[..., 0] * direction[:, 1:] - from_ray[..., 1] * direction[:, :1]) / turn
    distance_m = np.where((ahead_m > 0.0) & (share >= 0.0) & (share <= 1.0), ahead_m, np.inf)
    if skipped is not None:
        distance_m[np.arange(len(skipped)), skipped] = np.inf
    return distance_m


def _free_m(view: Snapshot, distance_m: np.ndarray, before_m: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return how far rays, `before_m` from the radar, go at each elevation before a high wall; [R, elevations]."""
    return np.asarray(_nearest_high(distance_m, before_m, view.blockers.height_m - view.world.radar_height_m, slope))


@compiled(error_model="numpy")
def _filled(change):  # type: ignore[no-untyped-def]
    """Return what is free in each cell from what begins and ends there, [directions, CELLS]."""
    out = np.empty((len(change), change.shape[1] - 1))
    for n in range(len(out)):
        total = 0.0
        for cell in range(out.shape[1]):
            total += change[n, cell]
            out[n, cell] = max(total, 0.0)
    return out


@compiled(error_model="numpy")
def _nearest_high(distance_m, before_m, over_m, slope):  # type: ignore[no-untyped-def]
    free_m = np.full((len(distance_m), len(slope)), np.inf)
    for ray in range(len(distance_m)):
        for wall in range(len(over_m)):
            reach_m = distance_m[ray, wall]
            if reach_m == np.inf:
                continue
            top = over_m[wall] / (reach_m + before_m[ray])
            for n in range(len(slope)):
                # elevations rise
                if slope[n] >= top:
                    break
                free_m[ray, n] = min(free_m[ray, n], reach_m)
    return free_m
