"""The effects of the simulator: one file each, and the tables that name them all.

A path effect is a module with `NAME`, `ABOUT`, `absent(world)` (why a scene has none of it, else None) and
`apply(tracing)` (its echoes; ways it found may serve the effects after it).
"""

from __future__ import annotations

from typing import Protocol

from sim_player.echoes import Echoes
from sim_player.effect_names import ALL_EFFECTS, PATH_EFFECTS, SIGNAL_EFFECTS, WEIGHT_EFFECTS, bit, check_effects
from sim_player.effects import (
    curved_wall,
    diffuse_scattering,
    edge_diffraction,
    ground_bounce,
    los_objects,
    los_surfaces,
    non_cofocal,
    object_interreflection,
    second_relay,
    specular_relay,
    wall_transmission,
)
from sim_player.effects.tracing import Tracing
from sim_player.world import World

__all__ = ["ALL_EFFECTS", "PATHS", "PATH_EFFECTS", "SIGNAL_EFFECTS", "WEIGHT_EFFECTS", "bit", "check_effects"]


class PathEffect(Protocol):
    """What a module of a path effect answers to."""

    NAME: str
    ABOUT: str

    def absent(self, world: World) -> str | None:
        """Why a scene has none of it; None where it may."""

    def apply(self, tracing: Tracing) -> Echoes:
        """Its echoes."""


_MODULES: tuple[PathEffect, ...] = (
    los_objects,
    los_surfaces,
    specular_relay,
    diffuse_scattering,
    curved_wall,
    second_relay,
    non_cofocal,
    wall_transmission,
    edge_diffraction,
    ground_bounce,
    object_interreflection,
)
PATHS: dict[str, PathEffect] = {module.NAME: module for module in _MODULES}
