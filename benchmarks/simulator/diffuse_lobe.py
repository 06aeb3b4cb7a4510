"""Random places with Kirchhoff's lobe on every wall, the default, beside Lambert's: what it changes.

All effects, at rest, no noise. Compared are cells (beams and map, `sim_player.planner.cells`) that either lobe lifts
10 dB over noise rms, and the power of all diffuse echoes without the antenna.
Usage: python -m benchmarks.simulator.diffuse_lobe [--places 40] [--seed 3] [--json]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.places import random_place
from sim_player.paths.conversion import as_paths
from sim_player.paths.ray_tracing import trace_echoes
from sim_player.planner.ablation import signal_effects
from sim_player.planner.cells import cells_of
from sim_player.scene.description import DiffuseLobe, Scene
from sim_player.scene.world import prepare, snapshot
from sim_player.signal.levels import kernel_profiles, noise_rms
from sim_player.trace.effect_names import bit

#: Random places of the page.
PLACES, SEED = 40, 3
CLEAR_DB = 10.0
#: Diffuse echoes of this incidence and more stand apart in the table [deg].
OBLIQUE_DEG = 20.0


@dataclass(frozen=True)
class Answer:
    """One place with one lobe: levels of all cells over noise [dB]; power of all diffuse echoes, of oblique ones."""

    level_db: np.ndarray
    diffuse: float
    oblique: float


def with_lobe(scene: Scene, lobe: DiffuseLobe) -> Scene:
    """Return a scene whose walls all scatter so."""
    surfaces = tuple(
        surface if surface.role == "ground" else msgspec.structs.replace(surface, diffuse_lobe=lobe)
        for surface in scene.surfaces
    )
    return msgspec.structs.replace(scene, surfaces=surfaces)


def answer_of(scene: Scene, seed: int) -> Answer:
    """Return the answer of a scene as it is."""
    world = prepare(scene, seed)
    setup, front_end, view = world.setup, scene.radar.front_end, snapshot(world, 0.0)
    flags = msgspec.structs.replace(signal_effects(ALL_EFFECTS), motion=False)
    echoes = trace_echoes(view, ALL_EFFECTS)
    profiles = kernel_profiles(setup, as_paths(view, echoes, ALL_EFFECTS), flags, front_end, precision="float64")
    values = np.abs(cells_of(setup).values(profiles)) / noise_rms(setup, flags, front_end)
    diffuse = echoes.take((echoes.needs & np.uint32(bit("diffuse_scattering"))) != 0)
    power = np.abs(diffuse.weight * diffuse.whole) ** 2
    cosine = np.abs(np.sum(diffuse.depart[:, :2] * view.normal[diffuse.surface], axis=1))
    oblique = cosine < np.cos(np.radians(OBLIQUE_DEG))
    return Answer(20.0 * np.log10(np.maximum(values, 1e-6)), float(power.sum()), float(power[oblique].sum()))


def change_of(scene: Scene, seed: int) -> dict[str, float | None]:
    """Return what changes from the cosine law to the default lobe: clear cells, and diffuse power [dB]; None: there is
    none.
    """
    before, after = (answer_of(with_lobe(scene, lobe), seed) for lobe in ("lambert", "kirchhoff"))
    clear = np.maximum(before.level_db, after.level_db) > CLEAR_DB
    change_db = np.abs(after.level_db - before.level_db)[clear]
    return {
        "largest_change_db": float(change_db.max(initial=0.0)),
        "share_over_1_db": float((change_db > 1.0).mean()) if change_db.size else 0.0,
        "diffuse_db": _ratio_db(after.diffuse, before.diffuse),
        "oblique_db": _ratio_db(after.oblique, before.oblique),
    }


def _ratio_db(after: float, before: float) -> float | None:
    return 10.0 * float(np.log10(max(after, 1e-30 * before) / before)) if before > 0.0 else None


def changes(places: int, seed: int) -> dict[str, Any]:
    """Return how many of some random places change, and percentiles of what changes in them."""
    rows = [change_of(random_place(seed, index), index) for index in range(places)]
    return {
        "places": places,
        "seed": seed,
        "with_rough_walls": sum(row["diffuse_db"] is not None for row in rows),
        "maps_over_1_db": sum((row["largest_change_db"] or 0.0) > 1.0 for row in rows),
        **{name: _quantiles(rows, name) for name in rows[0]},
    }


def _quantiles(rows: list[dict[str, float | None]], name: str) -> dict[str, float]:
    """Return the 10th, 50th and 90th percentile of a column over the places that have it."""
    values = [row[name] for row in rows if row[name] is not None]
    return {f"p{share}": round(float(np.percentile(values, share)), 4) for share in (10, 50, 90)}  # type: ignore[arg-type]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", type=int, default=PLACES)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    answer = changes(arguments.places, arguments.seed)
    print(json.dumps(answer) if arguments.json else "\n".join(f"{name}: {value}" for name, value in answer.items()))


if __name__ == "__main__":
    main()
