"""Weight effects: factors on the field of every echo, with the effect (`used`) or without, and their absences."""

from __future__ import annotations

import math

import numpy as np

from sim_player.scene.air import air_db_per_m
from sim_player.scene.world import World
from sim_player.trace.echoes import Echoes

Factor = np.ndarray | float


def rough_wall_loss(echoes: Echoes, world: World, used: bool) -> Factor:
    """Return what roughness leaves of a mirror: exp(-(4 pi s cos / lambda)^2) of power a bounce (Kirchhoff)."""
    return echoes.rough if used else 1.0


def slab_resonance(echoes: Echoes, world: World, used: bool) -> Factor:
    """Return the reflection by whole walls, Eq. (13) taken through all layers; unused: by their front face alone."""
    return echoes.whole if used else echoes.front


def vegetation(echoes: Echoes, world: World, used: bool) -> Factor:
    """Return what foliage lets pass (ITU-R P.833 form); it is no mirror. Unused: nothing stands there."""
    return echoes.foliage if used else 1.0


def atmosphere(echoes: Echoes, world: World, used: bool) -> Factor:
    """Return what gases, rain, snow and fog leave over a path's length: ITU-R P.676, P.838 and P.840."""
    if not used:
        return 1.0
    return np.asarray(10.0 ** (-air_db_per_m(world) * (echoes.out_m + echoes.back_m) / 20.0))


def no_roughness(world: World) -> str | None:
    """Smooth walls and a smooth ground lose nothing."""
    rough = (world.wall_roughness_m[world.is_mirror] > 0.0).any()
    ground = world.ground is not None and world.ground.roughness_mm > 0.0
    return None if rough or ground else "no wall is rough"


def no_backs(world: World) -> str | None:
    """Walls without a back have nothing to resonate."""
    backs = any(len(layers) > 1 or math.isfinite(layers[-1][1]) for layers in world.stacks)
    return None if backs else "no wall has a back"


def no_plants(world: World) -> str | None:
    """Foliage is what stands in a scene and is no mirror."""
    return "nothing grows here" if world.is_mirror.all() else None
