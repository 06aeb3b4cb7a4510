"""The converter rounds and clips (`receiver.convert`); under enough noise rounding is white noise of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.effects.noise_bounds import FAR_SIGMAS, wider
from sim_player.scene.world import World
from sim_player.signal.receiver import converter_step, quantisation_power_mw

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "adc"
ABOUT = "rounding of the converter"
COST_S = 0.0


def absent(world: World) -> str | None:
    """Every radar has it."""
    return None


def change(chain: Chain) -> np.ndarray:
    """The same noise draws, wider by the rounding's power."""
    power_mw = quantisation_power_mw(chain.setup, converter_step(chain.front_end))
    added = np.full(chain.shape[1], power_mw)
    return np.broadcast_to(FAR_SIGMAS * wider(chain.setup.radar, added), chain.shape)
