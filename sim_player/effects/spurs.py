"""Tones of the electronics, free of the chirps (`receiver.spur_beat`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.scene.world import World
from sim_player.signal.receiver import spur_profile

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "spurs"
ABOUT = "tones of the electronics"
COST_S = 0.0


def absent(world: World) -> str | None:
    """Only where the front end states them."""
    return None if world.scene.radar.front_end.spurs else "no spurs are stated"


def change(chain: Chain) -> np.ndarray:
    """Their own profiles; phases are drawn, magnitudes are not."""
    bins, radar = range(chain.shape[1]), chain.setup.radar
    profiles = [np.abs(spur_profile(radar, spur, 0.0, bins)) for spur in chain.front_end.spurs]
    return np.broadcast_to(np.sum(profiles, axis=0), chain.shape)
