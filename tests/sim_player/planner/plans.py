"""Plans of scenes."""

from __future__ import annotations

from sim_player.planner.plan import BUDGET_DB, Plan, plan_world
from sim_player.scene.description import Scene
from sim_player.scene.world import prepare


def plan_effects(scene: Scene, budget_db: float = BUDGET_DB, seed: int = 0) -> Plan:
    """The thorough plan of a scene."""
    return plan_world(prepare(scene, seed, scene.setup), scene.setup, budget_db, thorough=True)
