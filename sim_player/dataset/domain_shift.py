"""A harder copy of a series for tests of generalisation: rougher walls, clutter, and a board with faults.

The receiver knows the dead beams, but no gains and phases.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import msgspec
import numpy as np

from models.physics.plane import segment_distance_m
from msgs.values.radar import RadarSetup
from sim_player.dataset.labelled_scan import profile_noise
from sim_player.generate.placement import Boxes, Walls
from sim_player.generate.wall_kinds import FINISHES, surface
from sim_player.scene.description import Scene, check_scene

#: `none`: the series as it is.
Shift = Literal["none", "hard"]
SHIFTS: tuple[Shift, ...] = get_args(Shift)
#: Least distance of clutter from radar, walls and road users; and its sector before the radar.
RADAR_ROOM_M, CLEARANCE_M = 3.0, 0.4
FARTHEST_M, SECTOR_RAD = 40.0, math.radians(58.0)
#: Places tried for one piece of clutter before it is given up.
ATTEMPTS = 24


@dataclass(frozen=True)
class Clutter:
    """Upright pieces of one kind: finish, and the bands of width and height that they are drawn from."""

    finish: str
    length_m: tuple[float, float]
    height_m: tuple[float, float]


#: A metal post reflects at its ends alone; a metal sign is a mirror about as wide as a Fresnel zone.
POST = Clutter("metal", (0.06, 0.25), (1.0, 6.0))
SIGN = Clutter("metal", (0.4, 0.9), (1.5, 2.5))
BUSH = Clutter("hedge", (0.8, 2.5), (0.8, 3.0))


class ShiftParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Bands that one scene's shift is drawn from, ends included."""

    #: Rms roughness of all walls and of the ground is this much greater, one factor a scene.
    roughness_factor: tuple[float, float] = (2.0, 3.0)
    #: Pieces of clutter.
    posts: tuple[int, int] = (2, 5)
    signs: tuple[int, int] = (1, 3)
    bushes: tuple[int, int] = (1, 3)
    #: Amplitude of a beam's echoes: the spread of the gains measured on real 10 GHz boards.
    beam_gain: tuple[float, float] = (0.6, 1.0)
    #: Rms phase error of a beam.
    beam_phase_deg: float = 10.0
    dead_beams: tuple[int, int] = (1, 2)


HARD = ShiftParams()


@dataclass(frozen=True)
class BoardFaults:
    """Faults of a board in the beams of a scan: complex gain of the echoes [beams]; dead beams, bool [beams]."""

    gain: np.ndarray
    dead: np.ndarray


def domain_shifted_scene(scene: Scene, rng: np.random.Generator, params: ShiftParams = HARD) -> Scene:
    """Return the same place with rougher surfaces and clutter; passes `check_scene`."""
    factor = float(rng.uniform(*params.roughness_factor))
    surfaces = tuple(
        msgspec.structs.replace(piece, roughness_mm=factor * piece.roughness_mm) for piece in scene.surfaces
    )
    scene = msgspec.structs.replace(scene, surfaces=surfaces)
    for kind, band in ((POST, params.posts), (SIGN, params.signs), (BUSH, params.bushes)):
        for _ in range(_count(rng, band)):
            scene = _with_clutter(scene, kind, rng)
    check_scene(scene)
    return scene


def draw_faults(rng: np.random.Generator, beams: int, params: ShiftParams = HARD) -> BoardFaults:
    """Return the faults of one scan; a board with fewer beams than are to die keeps one."""
    gain = rng.uniform(*params.beam_gain, beams)
    phase_rad = math.radians(params.beam_phase_deg) * rng.standard_normal(beams)
    dead = np.zeros(beams, bool)
    dead[rng.permutation(beams)[: min(_count(rng, params.dead_beams), beams - 1)]] = True
    return BoardFaults(gain * np.exp(1j * phase_rad), dead)


def faulty_profiles(profiles: np.ndarray, faults: BoardFaults, setup: RadarSetup, seed: int) -> np.ndarray:
    """Return the profiles complex64 [beams, bins] of such a board, with as much noise; dead beams hold zeros."""
    # a gain of one may be over it by a rounding
    refill = np.sqrt(np.maximum(1.0 - np.abs(faults.gain[:, None]) ** 2, 0.0))
    # a seed of its own: the same draw would add up in amplitude
    noise = profile_noise(setup, seed ^ 1, profiles.shape[1])
    changed = faults.gain[:, None] * profiles + refill * noise
    return np.where(faults.dead[:, None], 0.0, changed).astype(np.complex64)


def _count(rng: np.random.Generator, band: tuple[int, int]) -> int:
    return int(rng.integers(band[0], band[1] + 1))


def _with_clutter(scene: Scene, kind: Clutter, rng: np.random.Generator) -> Scene:
    """Return a scene with one more piece of clutter where it has room, else the scene itself."""
    length_m, height_m = float(rng.uniform(*kind.length_m)), float(rng.uniform(*kind.height_m))
    for _ in range(ATTEMPTS):
        # uniform over the plane's sector before the radar
        range_m = math.sqrt(rng.uniform(RADAR_ROOM_M**2, FARTHEST_M**2))
        azimuth_rad, angle_rad = rng.uniform(-SECTOR_RAD, SECTOR_RAD), rng.uniform(0.0, math.pi)
        start = range_m * np.array([math.cos(azimuth_rad), math.sin(azimuth_rad)])
        ends = np.stack([start, start + length_m * np.array([math.cos(angle_rad), math.sin(angle_rad)])])
        if _has_room(scene, ends):
            a, b = ((float(x), float(y)) for x, y in ends)
            piece = surface(rng, FINISHES[kind.finish], (a, b), height_m)
            return msgspec.structs.replace(scene, surfaces=(*scene.surfaces, piece))
    return scene


def _has_room(scene: Scene, outline_m: np.ndarray) -> bool:
    """Return whether an outline [N, 2] keeps its distance from radar, walls and objects."""
    boxes = Boxes.of(scene.objects)
    upright = tuple(piece for piece in scene.surfaces if piece.role != "ground")
    walls = Walls.of(upright).footing if upright else (np.zeros((0, 2)), np.zeros((0, 2)))
    if np.linalg.norm(outline_m, axis=1).min() < RADAR_ROOM_M or boxes.contain(outline_m).any():
        return False
    start, end = boxes.faces
    a, b = np.concatenate([walls[0], start]), np.concatenate([walls[1], end])
    middle = outline_m.mean(axis=0)
    reach = float(np.linalg.norm(outline_m - middle, axis=1).max())
    return bool(segment_distance_m(middle[None], a, b).min(initial=np.inf) >= reach + CLEARANCE_M)
