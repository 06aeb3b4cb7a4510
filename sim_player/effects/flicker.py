"""1/f noise of the receiver at short range (`receiver.flicker_noise`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.effects.noise_bounds import FAR_SIGMAS, wider
from sim_player.scene.world import World
from sim_player.signal.receiver import flicker_ratio

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "flicker"
ABOUT = "1/f noise of the receiver at short range"
COST_S = 0.0


def absent(world: World) -> str | None:
    """Only where the front end states it."""
    return "the receiver has no 1/f noise" if world.scene.radar.front_end.flicker_corner_hz == 0.0 else None


def change(chain: Chain) -> np.ndarray:
    """The same noise draws, wider at low beats."""
    radar = chain.setup.radar
    beat_hz = np.arange(chain.shape[1]) / radar.chirp_period_s
    added = radar.noise_power_mw * flicker_ratio(radar, beat_hz, chain.front_end.flicker_corner_hz)
    return np.broadcast_to(FAR_SIGMAS * wider(radar, added), chain.shape)
