"""Tracing state of one instant, which the path effects share and extend in the order of `PATH_EFFECTS`."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sim_player.scene.segments import LEAST_LEFT, Occlusion
from sim_player.scene.world import Snapshot
from sim_player.trace.routes import Routes, mirror_routes, straight_routes


@dataclass
class TraceContext:
    """A snapshot, and the one-way routes to scattering centres that effects have found so far."""

    view: Snapshot
    routes: dict[str, Routes] = field(default_factory=dict)

    def clear_routes(self, *names: str) -> Routes:
        """Return the free routes to centres, straight or by mirrors alone, of some effects."""
        return Routes.joined([self.routes[name] for name in names if name in self.routes])

    @property
    def unbent_routes(self) -> Routes:
        """The routes to centres that bend nowhere: straight or by mirrors, clear or through walls."""
        return self.clear_routes("los_objects", "specular_relay", "curved_wall", "second_relay", "wall_transmission")

    @property
    def walls_let_through(self) -> bool:
        """Whether ways through walls are among the effects traced so far, and some wall lets something through."""
        world = self.view.world
        most = world.most_through[world.is_mirror].max(initial=0.0)
        return "wall_transmission" in self.routes and bool(most >= LEAST_LEFT)

    @cached_property
    def straight(self) -> tuple[Routes, Occlusion]:
        """Straight routes to all centres, blocked ones too, and their occlusion."""
        return straight_routes(self.view, self.view.centre, self.owner)

    @cached_property
    def mirrored(self) -> tuple[Routes, Occlusion]:
        """Routes to all centres by every straight piece of wall, blocked ones too, and their occlusion."""
        return mirror_routes(self.view, self.view.centre, self.view.world.is_flat, self.owner)

    @cached_property
    def owner(self) -> np.ndarray:
        """The object of every centre, int32 [K]."""
        return self.view.world.centres[4]
