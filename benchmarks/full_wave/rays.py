"""The ray tracer in two dimensions: the product's own echoes with cylindrical instead of spherical spreading.

Every factor of a route (Fresnel, roughness, focusing of an arc, bend at an edge) is defined against a flat mirror of
the route's length, and none depends on whether the wave spreads in one direction or two: the tracer stays as it is at
the antenna's height. In its weights the spherical 1 / L becomes the cylindrical H(L) = H0^(2)(k L), unit source:

    flash of a wall, radar in a corner: factors H(L) for lambda sqrt(P) / (4 pi L), the field of the image source
    object by routes out and back: factors F H(L_o) H(L_b) for sqrt(P lambda^2 sigma / (4 pi)^3) / (L_o L_b)

F is the scattering amplitude of the target. The grid's wave number and line source stand for those of free space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import hankel2

from benchmarks.full_wave.line_source import LineGrid
from models.physics.mirror import mirrored
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.effects.los_surfaces import flash_weight
from sim_player.paths.conversion import weights
from sim_player.paths.ray_tracing import trace_echoes
from sim_player.scene.wall_ends import NODE_M
from sim_player.scene.world import Snapshot, World, snapshot
from sim_player.trace.echoes import Echoes, echo_amplitude
from sim_player.trace.effect_names import bit

#: Bends and arcs turn a route by other angles than walls along the axes do.
TURNS = bit("edge_diffraction") | bit("curved_wall")
BENT_BY_MIRROR = bit("mirrored_diffraction")


@dataclass(frozen=True)
class RayField:
    """E echoes over a sweep: complex128 [E, frequencies], their names, and their delays as lengths [m]."""

    field: np.ndarray
    name: list[str]
    delay_m: np.ndarray

    def take(self, selection: np.ndarray) -> RayField:
        """Return the echoes of a mask."""
        return RayField(
            self.field[selection], [self.name[i] for i in np.flatnonzero(selection)], self.delay_m[selection]
        )


def ray_field(
    world: World, effects: frozenset[str], grid: LineGrid, frequency_hz: np.ndarray, amplitude: np.ndarray
) -> RayField:
    """Return the echoes of a world in the plane under some effects; `amplitude` is the target's F [frequencies]."""
    view = snapshot(world)
    echoes = trace_echoes(view, effects)
    echoes = echoes.take(echoes.weight != 0.0)
    factor = weights(echoes, world, effects)
    out_rad, back_rad = (
        _phase(grid, frequency_hz, view, echoes, length, depart)
        for length, depart in ((echoes.out_m, echoes.depart), (echoes.back_m, echoes.arrive))
    )
    gains = [grid.source_gain(frequency_hz, side[:, :2]) for side in (echoes.depart, echoes.arrive)]
    there_and_back = hankel2(0, out_rad) * hankel2(0, back_rad) * gains[0] * gains[1]
    round_trip = hankel2(0, out_rad + back_rad) * gains[0]
    unit_weight = echo_amplitude(world.radar, np.ones(1), np.ones(1))
    of_object = (factor * echoes.out_m * echoes.back_m / unit_weight) * there_and_back
    flash = factor / flash_weight(view, echoes.out_m + echoes.back_m) * round_trip
    field = np.where(echoes.object_index >= 0, of_object * amplitude[:, None], flash)
    return RayField(field.T, _names(world, echoes), _delay_m(out_rad + back_rad, frequency_hz))


def _phase(
    grid: LineGrid, frequency_hz: np.ndarray, view: Snapshot, echoes: Echoes, length_m: np.ndarray, depart: np.ndarray
) -> np.ndarray:
    """Return the phase of one-way routes on the grid [rad], [frequencies, E].

    Walls along the axes mirror a direction into one of the same wave number. A route that an edge or an arc turns has
    two segments, unfolded at its mirror: the turn is where the first, along the departure, leaves the length to the
    target or its image for the second.
    """
    ray, turned = _unfolded(view, echoes, length_m, depart)
    along = np.sum(depart[:, :2] * ray, axis=1)
    turned &= length_m - along > 1e-9
    first = np.where(
        turned, 0.5 * (length_m**2 - np.sum(ray**2, axis=1)) / np.where(turned, length_m - along, 1.0), length_m
    )
    onwards = np.where(turned[:, None], ray - first[:, None] * depart[:, :2], depart[:, :2])
    onwards /= np.linalg.norm(onwards, axis=1, keepdims=True)
    segments = ((depart[:, :2], first), (onwards, length_m - first))
    return np.asarray(sum(grid.wave_number(frequency_hz, direction) * span_m for direction, span_m in segments))


def _unfolded(
    view: Snapshot, echoes: Echoes, length_m: np.ndarray, depart: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the vectors [E, 2] to the targets or, behind a mirror, their images, and which routes are turned [E].

    Echoes with a bend beside a mirror do not say which of their two routes has it: its edge stands where a wall ends.
    """
    ray = echoes.point[:, :2] - view.origin
    of_object = echoes.object_index >= 0
    turned = ((echoes.needs & TURNS) > 0) & of_object
    for index in np.flatnonzero(((echoes.needs & BENT_BY_MIRROR) > 0) & of_object):
        ray[index], turned[index] = _unfold(view, ray[index], length_m[index], depart[index, :2])
    return ray, turned


def _unfold(view: Snapshot, ray: np.ndarray, length_m: float, depart: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the vector to a target's image by which a route along `depart` is straight, or else bends at an edge."""
    world, ends = view.world, np.concatenate([view.world.wall_a, view.world.wall_b])
    plain = [(ray, ends)]
    for wall in np.flatnonzero(world.is_flat):
        line = *view.normal[wall], view.offset[wall]
        image = np.array(mirrored(*(view.origin + ray), *line)) - view.origin
        # before the mirror the edge stands where it is, behind it at its image
        plain.append((image, np.concatenate([ends, np.column_stack(mirrored(*ends.T, *line))])))
    best = (np.inf, ray, True)
    for towards, edges in plain:
        missing = length_m - float(depart @ towards)
        if missing < 1e-9:
            return towards, False
        first = 0.5 * (length_m**2 - float(towards @ towards)) / missing
        best = min(best, (_nearest_m(view.origin + first * depart, edges), towards, True), key=lambda found: found[0])
    return best[1], best[2]


def _nearest_m(point: np.ndarray, others: np.ndarray) -> float:
    return float(np.linalg.norm(others - point, axis=1).min())


def _delay_m(phase_rad: np.ndarray, frequency_hz: np.ndarray) -> np.ndarray:
    """Return the group delay of every echo as a length [m]."""
    slope = (phase_rad[-1] - phase_rad[0]) / (2.0 * np.pi * (frequency_hz[-1] - frequency_hz[0]))
    return np.asarray(slope * SPEED_OF_LIGHT_MPS)


def _names(world: World, echoes: Echoes) -> list[str]:
    """Return the path group of every echo."""
    ends = np.concatenate([world.wall_a, world.wall_b])
    apart = np.linalg.norm(echoes.point[:, None, :2] - ends, axis=-1).min(axis=1)
    needs = [{name for name in _NAMED if row & bit(name)} for row in echoes.needs]
    same = np.isclose(echoes.out_m, echoes.back_m) & np.all(np.isclose(echoes.depart, echoes.arrive), axis=1)
    names = [_name(*row) for row in zip(needs, echoes.object_index >= 0, same, echoes.order, strict=True)]
    return ["end" if name == "flash" and away < NODE_M else name for name, away in zip(names, apart, strict=True)]


_NAMED = ("edge_diffraction", "mirrored_diffraction", "second_relay", "non_cofocal")


def _name(needs: set[str], of_object: bool, same: bool, order: int) -> str:
    if not of_object:
        return "radar twice mirrored" if "second_relay" in needs else "flash"
    if "mirrored_diffraction" in needs:
        return "mirrored, bent" if same else "mirrored, bent, mixed"
    if "edge_diffraction" in needs:
        return "diffracted" if same else "diffracted, mixed, twice mirrored" if order == 2 else "diffracted, mixed"
    if "non_cofocal" in needs:
        return "mixed, twice mirrored" if order == 2 else "mixed"
    return ("direct", "mirrored", "twice mirrored")[order]
