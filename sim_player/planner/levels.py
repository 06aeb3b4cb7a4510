"""Level at which a plan's signal is enough, and law of its rough walls, each with the reason."""

from __future__ import annotations

import math

import msgspec

from sim_player.effects.weights import no_roughness
from sim_player.planner.plan import Plan
from sim_player.signal.levels import kernel_objections


class Level(msgspec.Struct, frozen=True, kw_only=True):
    """Choice of one level, with its reason."""

    part: str
    choice: str
    reason: str


def levels_of(plan: Plan) -> tuple[Level, ...]:
    """Return the levels of signal and rough walls. The literal level, the reference of both others, is never needed."""
    return _signal(plan), _rough_walls(plan)


def _signal(plan: Plan) -> Level:
    """Kernel wherever it can hold the signal: it gives the map of the beats without the beats."""
    front_end = plan.view.world.scene.radar.front_end
    objections = kernel_objections(plan.setup, plan.paths, plan.signal, front_end)
    if objections:
        return Level(part="signal", choice="beat", reason="; ".join(objections))
    enough = "nothing moves, rounding is white and nothing clips: profiles equal those of beats; samples need beats"
    return Level(part="signal", choice="kernel", reason=enough)


def _rough_walls(plan: Plan) -> Level:
    """Kirchhoff's mean field: the simulator holds no table of a rough wall's own draw."""
    world = plan.view.world
    smooth = no_roughness(world)
    if smooth is not None:
        return Level(part="rough walls", choice="none", reason=smooth)
    roughest_m = float(world.wall_roughness_m.max(initial=0.0))
    turn_rad = 4.0 * math.pi * roughest_m / world.radar.wavelength_m
    reason = (
        f"the roughest wall ({1e3 * roughest_m:.1f} mm) turns phases by {turn_rad:.1f} rad rms; mean over all draws"
    )
    return Level(part="rough walls", choice="kirchhoff", reason=reason)
