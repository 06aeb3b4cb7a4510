"""Rain on the radome: a film of water in front of the antenna that every echo passes twice.

The film of a hemisphere in rain flows off as fast as it comes: Gibble's thickness (3 mu a R / (2 rho g))^(1/3) for the
radius a and the rain rate R (laminar flow). Its transmission is that of a slab of water at normal incidence, Eq. (13)
through both faces. Left out: beads and rivulets of a hydrophobic surface, and the film's variation over the radome.
"""

from __future__ import annotations

import numpy as np

from models.physics.fresnel import slab_transmission
from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes

ABOUT = "water on the radome"

RADIUS_M = 0.2
#: Water at 20 deg C: viscosity over density times gravity, m s; static and optical permittivity; relaxation time.
_FLOW_M_S = 1.0e-3 / (998.0 * 9.81)
_STATIC, _OPTICAL, _RELAXATION_S = 80.2, 5.3, 9.4e-12
_MPS_PER_MM_PER_H = 1e-3 / 3600.0


def absent(world: World) -> str | None:
    """Return why a scene has none of it: the planner writes it down."""
    return None if world.scene.weather.rain_mm_per_h > 0.0 else "it does not rain"


def factor(echoes: Echoes, world: World, used: bool) -> np.ndarray | float:
    """Return what the field of each echo is multiplied by, with the effect (`used`) and without."""
    return film_transmission(world.scene.weather.rain_mm_per_h, world.radar.carrier_hz) ** 2 if used else 1.0


def film_thickness_m(rain_mm_per_h: float) -> float:
    """Return the thickness of the film, m."""
    return float((1.5 * _FLOW_M_S * RADIUS_M * rain_mm_per_h * _MPS_PER_MM_PER_H) ** (1.0 / 3.0))


def film_transmission(rain_mm_per_h: float, frequency_hz: float) -> complex:
    """Return the complex factor of the field on one pass; water by Debye's law, Im <= 0."""
    water = _OPTICAL + (_STATIC - _OPTICAL) / (1.0 + 2j * np.pi * frequency_hz * _RELAXATION_S)
    wavelength_m = 299_792_458.0 / frequency_hz
    return complex(slab_transmission(water, 1.0, film_thickness_m(rain_mm_per_h), wavelength_m))
