"""Every echo the tracer finds in a scene: its path, length, direction and weight."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from msgs.values.perception import PathClass
from sim_player.paths.ray_tracing import trace
from sim_player.paths.truth import best_power_mw, hidden_objects
from sim_player.paths.vertices import outbound_vertices
from sim_player.planner.plan import BUDGET_DB, resolve_plan
from sim_player.planner.purposes import Purpose, purpose_of
from sim_player.scene.description import Scene
from sim_player.scene.world import prepare
from sim_player.trace.effect_names import PATH_EFFECTS, PLUGGED_IN, bit
from sim_player.trace.path_table import Paths


class EchoPaths(NamedTuple):
    """Paths of a scene, the strongest first: their power [mW] and the vertices of each [V, 3]."""

    paths: Paths
    power_mw: np.ndarray
    vertices_m: list[np.ndarray]


class PlanChoice(NamedTuple):
    """Effects by a word, and what "auto" keeps."""

    effects: str
    budget_db: float = BUDGET_DB
    purpose: str = Purpose.SAMPLES.value


class PathFilter(NamedTuple):
    """Paths to keep: all that pass every condition, then the strongest of them."""

    hidden_only: bool = False
    kind: str | None = None
    strongest: int | None = None

    def passes(self, paths: Paths) -> np.ndarray:
        """Return which paths to keep, without regard to their strength."""
        kept = np.ones(len(paths), bool)
        if self.hidden_only:
            kept &= np.isin(paths.object_index, list(hidden_objects(paths)))
        if self.kind is not None:
            kept &= (paths.kind == PathClass.MIRRORED) == (self.kind == "mnlos")
        return kept


def echo_paths(scene: Scene, seed: int, choice: PlanChoice, wanted: PathFilter) -> EchoPaths:
    """Trace a scene with some effects, and keep the paths that are wanted."""
    world = prepare(scene, seed)
    plan = resolve_plan(world, scene.setup, choice.effects, choice.budget_db, purpose=purpose_of(choice.purpose))
    paths = trace(world) if plan is None else plan.paths
    power_mw = best_power_mw(scene.setup, paths)
    order = np.argsort(-power_mw, kind="stable")
    kept = order[wanted.passes(paths)[order]][: wanted.strongest]
    return EchoPaths(paths.take(kept), power_mw[kept], outbound_vertices(world, paths.take(kept)))


def path_row(paths: Any, index: int, vertices_m: Any) -> dict[str, Any]:
    """One path as the contract has it (DESIGN section 4), with the effects it needs."""
    weight = complex(paths.amplitude[index])
    return {
        "kind": _kind(paths, index),
        "order": int(paths.order[index]),
        "points_m": vertices_m.tolist(),
        "virtual_m": paths.virtual_m[index].tolist(),
        "length_m": float(paths.length_m[index]),
        "amplitude": [weight.real, weight.imag],
        "surface": int(paths.surface[index]),
        "object": int(paths.object_index[index]),
        "effects": _needs(paths, index),
    }


def path_line(paths: Any, index: int, power_mw: float) -> tuple[object, ...]:
    """Return one path as a row of the table."""
    return (
        _kind(paths, index),
        int(paths.order[index]),
        f"{paths.length_m[index]:.2f}",
        f"{math.degrees(paths.azimuth_rad[index]):.1f}",
        f"{10.0 * math.log10(max(power_mw, 1e-30)):.0f}",
        *(None if number < 0 else int(number) for number in (paths.object_index[index], paths.surface[index])),
        ", ".join(_needs(paths, index)),
    )


def _kind(paths: Any, index: int) -> str:
    return "mnlos" if paths.kind[index] == PathClass.MIRRORED else "los"


def _needs(paths: Any, index: int) -> list[str]:
    return [name for name in (*PATH_EFFECTS, *PLUGGED_IN) if int(paths.needs[index]) & bit(name)]
