"""Paths of a foreign tracer from the antenna to points, and their way into our routes, echoes and paths.

A foreign tracer needs to find one-way paths only. Scatterers, radar equation, mixtures of two routes, walls in direct
sight and everything along the sweep are ours: paths from the foreign tracer, beats from ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.foreign.export import ExportedSurface, SurfaceKind
from msgs.values.array_table import ArrayTable
from sim_player.effects.table import PATHS
from sim_player.paths.conversion import as_paths
from sim_player.scene.segments import Occlusion
from sim_player.scene.world import Snapshot
from sim_player.trace.echoes import Echoes, cofocal, object_echoes
from sim_player.trace.effect_names import bit
from sim_player.trace.path_table import Paths
from sim_player.trace.routes import NONE, Routes, make_routes
from sim_player.trace.snapshot import TraceContext


@dataclass(frozen=True)
class OneWayPaths(ArrayTable):
    """N paths from one source to points, by D specular reflections at most, in the scene's frame."""

    #: Index of the point, int32 [N].
    target: np.ndarray
    length_m: np.ndarray
    #: Unit vectors of travel at the source and at the point, [N, 3].
    depart: np.ndarray
    arrive: np.ndarray
    #: Product of the field reflection coefficients for vertical polarisation (e^{+jwt}), complex128 [N].
    reflection: np.ndarray
    #: Index of the exported surface of each reflection, -1 for none, int32 [N, D], and its position [N, D, 3].
    surface: np.ndarray
    vertex_m: np.ndarray


def as_routes(paths: OneWayPaths, surfaces: tuple[ExportedSurface, ...]) -> Routes:
    """Return one-way paths as routes; reflections at objects and the ground are marked as effects without truth."""
    kind, index = surface_columns(surfaces)
    on_wall = kind[paths.surface] == SurfaceKind.WALL
    piece = np.where(on_wall, index[paths.surface], NONE)
    # walls first, in the order they are met
    piece = np.take_along_axis(piece, np.argsort(~on_wall, axis=1, kind="stable"), axis=1)
    piece = np.column_stack([piece, np.full((len(paths), 2), NONE)])
    on_ground = (kind[paths.surface] == SurfaceKind.GROUND).any(axis=1)
    on_object = (kind[paths.surface] == SurfaceKind.OBJECT).any(axis=1)
    needs = (
        np.where(piece[:, 0] >= 0, bit("specular_relay"), 0)
        | np.where(piece[:, 1] >= 0, bit("second_relay"), 0)
        | np.where(on_ground, bit("ground_bounce"), 0)
        | np.where(on_object, bit("object_interreflection"), 0)
    )
    whole = np.ones(len(paths), np.complex128)
    clear = Occlusion(np.ones(len(paths), bool), whole, whole, np.ones(len(paths)))
    return make_routes(
        paths.target,
        paths.length_m,
        paths.depart,
        paths.arrive,
        clear,
        needs,
        wall=piece[:, 0],
        wall2=piece[:, 1],
        ground=on_ground,
        whole=paths.reflection,
        front=paths.reflection,
    )


def foreign_paths(view: Snapshot, routes: Routes, effects: frozenset[str]) -> Paths:
    """Return the paths of a scene whose objects are reached by foreign routes; `effects` as for `trace`.

    Of the path effects, `non_cofocal` and `los_surfaces` (ours: walls are no points) are taken from `effects`; the
    others are those that the routes contain.
    """
    plain = (routes.needs & np.uint32(bit("ground_bounce") | bit("object_interreflection"))) == 0
    tracing = TraceContext(view, {"second_relay": routes.take(plain)})
    parts = [object_echoes(view, routes, cofocal(routes))]
    for name in ("los_surfaces", "non_cofocal"):
        if name in effects and PATHS[name].absent(view.world) is None:
            parts.append(PATHS[name].apply(tracing))
    return as_paths(view, Echoes.joined(parts), effects)


def meets_own_object(paths: OneWayPaths, surfaces: tuple[ExportedSurface, ...], owner: np.ndarray) -> np.ndarray:
    """Return which paths are mirrored by the object that their point belongs to, bool [N]; `owner` [points], -1 none.

    The point stands for that echo already: leave these paths out before `as_routes`.
    """
    kind, index = surface_columns(surfaces)
    own = (kind[paths.surface] == SurfaceKind.OBJECT) & (index[paths.surface] == owner[paths.target][:, None])
    return np.asarray(own.any(axis=1))


def surface_columns(surfaces: tuple[ExportedSurface, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the kind and index of every surface, [S + 1]; the last row is that of no surface (-1)."""
    kind = np.array([*(surface.kind for surface in surfaces), NONE], np.int32)
    return kind, np.array([*(surface.index for surface in surfaces), NONE], np.int32)
