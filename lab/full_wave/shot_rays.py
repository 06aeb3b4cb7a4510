"""Radar cross section of meshes by shooting and bouncing rays: the reference of the bodies in scenes.

Fields are square roots of RCS with a phase: |field|^2 is the RCS in m^2, and far away the phase of a point p is
exp(+j k (s + r).p), s and r unit vectors to source and receiver (e^{+jwt}, origin of the mesh's frame at its foot).

Not modelled: diffraction by edges beyond physical optics, creeping waves, transmission through thin dielectric faces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from models.compiled import compiled
from models.physics.fresnel import Polarisation
from sim_player.bodies.meshes import Mesh
from sim_player.bodies.triangles import (
    ahead,
    cross,
    cut_triangles,
    dot,
    first_hit,
    lookup,
    radiated_field,
    reflected,
    reflection_table,
    row,
    search_tree,
    sinc,
    triangle_areas,
)

#: Default largest spacing of rays as a share of a wavelength.
RAY_SPACING = 1.0 / 8.0
MAX_RAYS = 16_000_000
#: Longest edge of the piece of a face that one centre stands for, as a share of a wavelength.
CENTRE_SPACING = 0.25


@dataclass(frozen=True)
class MeshCentres:
    """Scattering centres of a mesh, K of them; the phase of a centre is that of its position."""

    #: Position and outward normal [K, 3], RCS along the normal [K] m^2, exponent of its lobe cos^q of power [K].
    position_m: np.ndarray
    normal: np.ndarray
    peak_rcs_m2: np.ndarray
    lobe_exponent: np.ndarray


def mesh_centres(mesh: Mesh, wavelength_m: float) -> MeshCentres:
    """Return a mesh as points for tracers that know points with lobes: their coherent sum is its physical optics.

    Each is a piece of a face, so small that its lobe is the cosine of physical optics alone: side lobes come from the
    sum. It has the reflectance at normal incidence. One bounce; parts do not hide each other.
    """
    pieces, owner = cut_triangles(mesh.corners_m, CENTRE_SPACING * wavelength_m)
    te, _ = reflection_table(mesh.material, wavelength_m)
    peak_rcs_m2 = 4.0 * math.pi * abs(te[-1]) ** 2 * (triangle_areas(pieces) / wavelength_m) ** 2
    return MeshCentres(pieces.mean(axis=1), mesh.normals[owner], peak_rcs_m2, np.full(len(pieces), 2.0))


def mesh_field(
    mesh: Mesh,
    direction: np.ndarray,
    wavelength_m: float,
    bounces: int = 3,
    ray_spacing_m: float | None = None,
    polarisation: Polarisation = "te",
) -> complex:
    """Return the square root of the monostatic RCS with its phase: physical optics of the rays' currents at every
    bounce.

    A grid of rays no wider than `ray_spacing_m` (None: lambda / 8) falls on the mesh from `direction` and is followed
    through up to `bounces` faces, both sides of which reflect. At each, the total field n x H, E x n of the ray's tube
    radiates back if nothing blocks the radar; the tube's footprint is integrated in closed form on the face's
    plane, so the spacing only limits the accuracy at edges. Materials reflect as half-spaces (TE and TM apart).
    `te`: the radar's field is as upright as it can be. Raises ValueError for more than 16 million rays.
    """
    towards = np.asarray(direction, np.float64)
    if towards.shape != (3,) or not np.isfinite(towards).all() or not np.linalg.norm(towards) > 0.0:
        raise ValueError(f"direction must be three finite numbers, not all zero, got {direction!r}")
    if bounces < 1:
        raise ValueError(f"bounces must be at least 1, got {bounces!r}")
    towards = towards / np.linalg.norm(towards)
    across, up = _aperture_axes(towards)
    spacing = RAY_SPACING * wavelength_m if ray_spacing_m is None else ray_spacing_m
    start, cell = _ray_grid(mesh, towards, across, up, spacing)
    field = _shoot(
        *search_tree(mesh.corners_m),
        start,
        towards,
        cell[0] * across,
        cell[1] * up,
        up if polarisation == "te" else across,
        2.0 * math.pi / wavelength_m,
        bounces,
        *reflection_table(mesh.material, wavelength_m),
        1e-7 * float(mesh.extent_m.max()),
    )
    return complex(math.sqrt(4.0 * math.pi) / wavelength_m * cell[0] * cell[1] * field)


def _aperture_axes(towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors across the line of sight: level, and as upright as possible."""
    across = np.cross([0.0, 0.0, 1.0], towards)
    # straight from above there is no level axis; y is as good as any
    across = np.array([0.0, 1.0, 0.0]) if np.linalg.norm(across) < 1e-9 else across / np.linalg.norm(across)
    return across, np.cross(towards, across)


def _ray_grid(
    mesh: Mesh, towards: np.ndarray, across: np.ndarray, up: np.ndarray, spacing_m: float
) -> tuple[np.ndarray, tuple[float, float]]:
    """Return the starts of all rays [N, 3] on a plane before the mesh, in the middles of cells that tile its
    outline's box.
    """
    if not (math.isfinite(spacing_m) and spacing_m > 0.0):
        raise ValueError(f"ray_spacing_m must be finite and positive, got {spacing_m!r}")
    projected = mesh.vertices_m @ np.stack([across, up, towards]).T
    least, size = projected.min(axis=0), np.ptp(projected, axis=0)
    # even numbers: no ray hits the middle edge of a symmetric corner
    count = 2.0 * np.maximum(np.ceil(0.5 * size[:2] / spacing_m * (1.0 - 1e-9)), 1.0)
    if count.prod() > MAX_RAYS:
        raise ValueError(
            f"ray_spacing_m: at most {MAX_RAYS} rays, got {count.prod():.3g} for {size[0]:.3g} x {size[1]:.3g} m "
            f"at {spacing_m:.3g} m"
        )
    cell = size[:2] / count
    columns, rows = (least[axis] + (np.arange(count[axis]) + 0.5) * cell[axis] for axis in (0, 1))
    before = (least[2] + size[2] + max(size[2], 1e-3)) * towards
    start = before + (columns[:, None, None] * across + rows[None, :, None] * up)
    return start.reshape(-1, 3), (float(cell[0]), float(cell[1]))


@compiled
def _shoot(faces, bounds, first, count, start, towards, across, up, receive, wavenumber, bounces, te, tm, nearest):  # type: ignore[no-untyped-def]
    """Return the sum over rays and bounces of radiated field times footprint, in units of a ray's cross section."""
    towards_, receive_ = (towards[0], towards[1], towards[2]), (receive[0], receive[1], receive[2])
    total = 0.0j
    for ray in range(len(start)):
        position, direction = row(start, ray), (-towards[0], -towards[1], -towards[2])
        phase_m = dot(position, towards_)
        first_edge, second_edge = (across[0], across[1], across[2]), (up[0], up[1], up[2])
        field = (receive[0] + 0.0j, receive[1] + 0.0j, receive[2] + 0.0j)
        for bounce in range(bounces):
            distance, hit = first_hit(faces, bounds, first, count, 0, position, direction, nearest)
            if hit < 0:
                break
            a = row(faces[hit], 0)
            normal = cross(ahead(row(faces[hit], 1), -1.0, a), ahead(row(faces[hit], 2), -1.0, a))
            slant = dot(normal, direction)
            # the side that the ray meets
            scale = (-1.0 if slant > 0.0 else 1.0) / math.sqrt(dot(normal, normal))
            normal = (scale * normal[0], scale * normal[1], scale * normal[2])
            cosine = min(-dot(normal, direction), 1.0)
            if cosine < 1e-6:
                break
            position = ahead(position, distance, direction)
            phase_m -= distance
            out = ahead(direction, 2.0 * cosine, normal)
            field_out = reflected(field, direction, out, normal, lookup(te, cosine), lookup(tm, cosine))
            # the tube's footprint on this face
            first_edge = ahead(first_edge, dot(normal, first_edge) / cosine, direction)
            second_edge = ahead(second_edge, dot(normal, second_edge) / cosine, direction)
            is_visible = dot(normal, towards_) > 1e-9
            if is_visible and bounce > 0:
                is_visible = first_hit(faces, bounds, first, count, 0, position, towards_, nearest)[1] < 0
            if is_visible:
                turn = ahead(towards_, -1.0, direction)
                lobe = sinc(0.5 * wavenumber * dot(turn, first_edge)) * sinc(0.5 * wavenumber * dot(turn, second_edge))
                angle = wavenumber * (phase_m + dot(towards_, position))
                radiated = radiated_field(field, field_out, direction, out, normal, towards_, receive_)
                total += radiated * lobe / cosine * (math.cos(angle) + 1j * math.sin(angle))
            direction, field = out, field_out
    return total
