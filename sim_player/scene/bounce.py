"""One bounce at a wall, compiled, by the laws of `models.physics.fresnel` (TE): whole build, front face, roughness."""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled
from models.physics.diffraction import passed_edge_at
from models.physics.fresnel import slab_at, stack_at

Layers = tuple[tuple[complex, float], ...]
#: Of every wall the first of its layers, how many they are (0: foliage) and its roughness [m], [W, 3]; permittivity
#: and thickness of all layers, [L] each; wavelength.
Builds = tuple[np.ndarray, np.ndarray, np.ndarray, float]


def builds_of(
    stacks: tuple[Layers, ...], wall_stack: np.ndarray, roughness_m: np.ndarray, wavelength_m: float
) -> Builds:
    """Return the builds of walls as compiled code takes them; `wall_stack` [W] is -1 for foliage."""
    count = np.array([len(layers) for layers in stacks] + [0])
    first = np.append(0, np.cumsum(count))[:-1]
    layers = [layer for stack in stacks for layer in stack]
    return (
        np.column_stack([first[wall_stack], count[wall_stack], roughness_m]).astype(np.float64),
        np.array([permittivity for permittivity, _ in layers], np.complex128),
        np.array([thickness_m for _, thickness_m in layers], np.float64),
        wavelength_m,
    )


@compiled(error_model="numpy")
def bounce(builds, wall, cosine):  # type: ignore[no-untyped-def]
    """Return the field factors of one bounce: the wall as built, its front face alone, what roughness leaves."""
    table, permittivity, thickness_m, wavelength_m = builds
    first, count = int(table[wall, 0]), int(table[wall, 1])
    cosine = min(cosine, 1.0)
    rough = coherent_field(table[wall, 2], cosine, wavelength_m)
    if count == 0:
        return 0.0j, 0.0j, rough
    if count == 1:
        whole, front = slab_at(permittivity[first], cosine, thickness_m[first], wavelength_m)
    else:
        last = first + count
        whole, front = stack_at(permittivity[first:last], thickness_m[first:last], cosine, wavelength_m)
    return whole, front, rough


@compiled(error_model="numpy")
def below_top(wavelength_m, clearance_m, before_m, behind_m, rise):  # type: ignore[no-untyped-def]
    """Return the field that a wall's top leaves of a mirrored ray that meets the wall so far below it (negative: over).

    Lengths before and behind, `rise` its upright cosine; 1/2 at the top, exactly 1 and 0 far off (`passed_edge_at`).
    """
    upright = math.sqrt(max(1.0 - rise * rise, 0.0))
    return passed_edge_at(clearance_m * upright, max(before_m, 1e-3), max(behind_m, 1e-3), wavelength_m)


@compiled(error_model="numpy")
def all_below_top(wavelength_m, clearance_m, before_m, behind_m, rise):  # type: ignore[no-untyped-def]
    """Return `below_top` of N rays."""
    left = np.empty(len(clearance_m), np.complex128)
    for n in range(len(left)):
        left[n] = below_top(wavelength_m, clearance_m[n], before_m[n], behind_m[n], rise[n])
    return left


@compiled(error_model="numpy")
def coherent_field(roughness_m, cosine, wavelength_m):  # type: ignore[no-untyped-def]
    """Return what roughness leaves of a mirrored field: the root of `models.physics.fresnel.coherent_power`."""
    phase_rad = 4.0 * np.pi * roughness_m * cosine / wavelength_m
    return math.exp(-0.5 * phase_rad * phase_rad)


@compiled(error_model="numpy")
def all_bounces(builds, walls, cosines):  # type: ignore[no-untyped-def]
    """Return `bounce` of walls [N] at cosines [N]."""
    whole, front = np.empty(len(walls), np.complex128), np.empty(len(walls), np.complex128)
    rough = np.empty(len(walls))
    for n in range(len(walls)):
        whole[n], front[n], rough[n] = bounce(builds, walls[n], cosines[n])
    return whole, front, rough
