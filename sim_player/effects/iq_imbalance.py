"""Gain and phase between I and Q: a weak image of everything at negative beats (`receiver.iq_imbalance`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim_player.effects.noise_bounds import FAR_SIGMAS
from sim_player.scene.world import World
from sim_player.signal.receiver import iq_factors

if TYPE_CHECKING:
    from sim_player.planner.ablation import Chain

NAME = "iq_imbalance"
ABOUT = "gain and phase between I and Q"
COST_S = 0.0


def absent(world: World) -> str | None:
    """Only where the front end states it."""
    return "I and Q agree" if iq_factors(world.scene.radar.front_end)[1] == 0.0 else None


def change(chain: Chain) -> np.ndarray:
    """The gain's change on all that is there, and the image's skirts: from +f at -f, in the map by the window alone."""
    wanted, image = iq_factors(chain.front_end)
    echoes = chain.bound(chain.amplitude)
    return np.asarray(abs(wanted - 1.0) * (echoes + FAR_SIGMAS * chain.noise_rms) + abs(image) * _image(echoes))


def _image(echoes: np.ndarray) -> np.ndarray:
    """Bound of the mirrored profile: an echo at bin b reaches bin i over i + b bins, Hann skirts fall as 1 / x^3."""
    bins = np.arange(echoes.shape[1])
    away = bins[:, None] + bins[None]
    return np.asarray(echoes @ np.where(away < 2, 1.0, 1.0 / np.maximum(away, 2.0) ** 3))
