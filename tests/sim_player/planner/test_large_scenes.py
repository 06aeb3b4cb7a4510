"""The planner's law on scenes that are traced in part: against every path of the whole scene."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from benchmarks.simulator.city import CityKind, made_city
from sim_player.effects.table import ALL_EFFECTS
from sim_player.paths.conversion import as_paths
from sim_player.paths.ray_tracing import trace_echoes
from sim_player.paths.reach import reachable_snapshot
from sim_player.planner.ablation import signal_effects
from sim_player.planner.cells import cells_of
from sim_player.planner.plan import Plan, clean_profiles, plan_world, planned_profiles
from sim_player.planner.purposes import Purpose
from sim_player.scene.world import World, prepare, snapshot
from sim_player.signal.levels import kernel_profiles, noise_profiles, noise_rms

FLAGS = msgspec.structs.replace(signal_effects(ALL_EFFECTS), motion=False)


class Everything:
    """A world with every path and effect, its noise and the rms of that: what plans are held against."""

    def __init__(self, world: World) -> None:
        self._setup, front_end, view = world.setup, world.scene.radar.front_end, snapshot(world)
        self._paths = as_paths(view, trace_echoes(view, ALL_EFFECTS), ALL_EFFECTS)
        self._noise = noise_profiles(self._setup, 0, FLAGS, front_end)
        self._rms = noise_rms(self._setup, FLAGS, front_end)
        clean = kernel_profiles(self._setup, self._paths, FLAGS, front_end, precision="float64")
        self._profiles = clean + self._noise

    def largest_change(self, plan: Plan) -> float:
        """Return the law's ratio in the plan's worst cell, by its paths and by its evaluated answer, same noise."""
        cells = cells_of(self._setup)
        answers = [answer(plan, self._setup) + self._noise for answer in (planned_profiles, clean_profiles)]
        return max(float(cells.off(self._profiles, answer, self._rms, plan.purpose).max()) for answer in answers)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "walls", "seed"), [("terraced", 200, 0), ("detached", 400, 2)])
def test_the_law_holds_against_the_whole_city(kind: CityKind, walls: int, seed: int) -> None:
    """Half of the paths are traced at most; no cell is off by more than the budget."""
    world = prepare(made_city(walls, kind, seed=seed), seed)
    reachable = len(trace_echoes(reachable_snapshot(world), ALL_EFFECTS))
    everything = Everything(world)
    for purpose in Purpose:
        plan = plan_world(world, world.setup, -20.0, purpose=purpose)
        assert plan.traced < 0.6 * reachable
        assert everything.largest_change(plan) <= 0.1


def test_bounds_look_all_round() -> None:
    """What the element pattern alone changes is asked of all paths: behind the antenna it takes everything."""
    world = prepare(made_city(100, "detached", objects=2))
    quick, thorough = (plan_world(world, world.setup, thorough=flag, purpose=Purpose.PEAKS) for flag in (False, True))
    assert quick.view.ahead_only
    bound_db = {effect.name: effect.bound_db for effect in thorough.effects}["element_pattern"]
    assert bound_db is not None
    assert bound_db > 0.0
    np.testing.assert_array_equal(quick.echoes.chain, thorough.echoes.chain)
