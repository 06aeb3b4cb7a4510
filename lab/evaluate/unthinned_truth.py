"""All echoes that can have truth points, before thinning: scenes of a data set traced again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from msgs.values.radar import RadarSetup
from msgs.values.units import ratio_from_db
from sim_player.dataset.labelled_scan import label_points
from sim_player.dataset.shards import scene_seed
from sim_player.effects.table import ALL_EFFECTS
from sim_player.paths.ray_tracing import trace
from sim_player.paths.truth import VISIBLE_SNR_DB, best_power_mw, labelled
from sim_player.planner.plan import manual_plan, plan_world
from sim_player.planner.purposes import purpose_of
from sim_player.scene.description import Scene, scene_from_yaml
from sim_player.scene.world import prepare
from sim_player.trace.path_table import Paths


class DrawnScene(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters that fix a scene's echoes: its YAML, number and gain, and its series (`series.json`)."""

    scene_yaml: str
    index: int
    gain_db: float
    series: dict[str, Any]

    @property
    def setup(self) -> RadarSetup:
        """The scene's radar with the gain of the data set; with basic effects, echoes are judged without it."""
        setup, gain = self.scene.setup, ratio_from_db(self.gain_db)
        if self.series.get("effects") == "basic":
            return setup
        radar = msgspec.structs.replace(setup.radar, transmit_power_w=gain * setup.radar.transmit_power_w)
        return msgspec.structs.replace(setup, radar=radar)

    @property
    def scene(self) -> Scene:
        """The scene; its mesh files, if any, must lie where its YAML says."""
        return scene_from_yaml(self.scene_yaml, Path())


def trace_again(drawn: DrawnScene) -> Paths:
    """Return all paths of a scene as when its data set was made.

    Raises `ValueError` where the series is none of the simulator's.
    """
    if "scans" in drawn.series:
        raise ValueError(
            f"series.json must be of places at rest to be traced again, scans is {drawn.series['scans']!r}"
        )
    missing = [name for name in ("seed", "effects") if name not in drawn.series]
    if missing:
        raise ValueError(f"series.json must say {' and '.join(missing)} so that scenes can be traced again")
    scene, setup, effects = drawn.scene, drawn.setup, drawn.series["effects"]
    world = prepare(scene, scene_seed(drawn.series["seed"], drawn.index), setup)
    if effects == "auto":
        purpose = purpose_of(drawn.series.get("purpose", "samples"))
        return plan_world(world, setup, drawn.series["budget_db"], purpose=purpose).labelled
    if effects == "basic":
        return trace(world)
    return manual_plan(world, setup, ALL_EFFECTS if effects == "all" else frozenset(effects)).paths


def labelled_paths(drawn: DrawnScene) -> tuple[Paths, np.ndarray]:
    """Return all echoes over the noise that can have truth points, and the ranges [m] of the truth points, in order.

    Raises `ValueError` as above.
    """
    paths = trace_again(drawn)
    return unthinned_paths(drawn.setup, paths), label_points(drawn.setup, paths).range_m


def unthinned_paths(setup: RadarSetup, paths: Paths) -> Paths:
    """Return the candidates of `sim_player.paths.truth.visible_paths`: labelled, in the grid, over the noise in some
    beam.
    """
    grid, radar = setup.map_grid, setup.radar
    noise_mw = radar.noise_power_mw / (radar.samples_per_chirp * radar.chirps_per_beam)
    row, column = grid.range_index(0.5 * paths.length_m), grid.azimuth_index(paths.azimuth_rad)
    inside = (row <= grid.range_bins - 1) & (column >= 0.0) & (column <= grid.azimuth_bins - 1)
    over_noise = best_power_mw(setup, paths) > noise_mw * ratio_from_db(VISIBLE_SNR_DB)
    return paths.take(labelled(paths) & inside & over_noise)
