"""The transmitter straight into the receiver: a beat at nearly zero range (`receiver.leakage_beat`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.scene.world import World
from sim_player.signal.receiver import leakage_profile

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "leakage"
ABOUT = "transmitter straight into the receiver"
COST_S = 0.0


def absent(world: World) -> str | None:
    """Only where the front end states it."""
    return "no leakage is stated" if world.scene.radar.front_end.leakage_dbm is None else None


def change(chain: Chain) -> np.ndarray:
    """Its own profile."""
    power_dbm = chain.front_end.leakage_dbm
    if power_dbm is None:
        return np.zeros(chain.shape)
    profile = leakage_profile(chain.setup.radar, power_dbm, range(chain.shape[1]))
    return np.broadcast_to(np.abs(profile), chain.shape)
