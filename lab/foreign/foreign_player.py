"""Player of a place at rest in a foreign world: objects are reached by foreign paths, beats are ours."""

from __future__ import annotations

import numpy as np

from lab.foreign.export import clear_of_bodies, exported_surfaces
from lab.foreign.one_way import as_routes, foreign_paths, meets_own_object
from lab.foreign.sionna_tracer import trace_to_points
from msgs.values.radar import RadarSetup
from sim_player.effects.table import ALL_EFFECTS
from sim_player.player import ScenePlayer
from sim_player.scene.description import Scene
from sim_player.scene.world import snapshot
from sim_player.signal.levels import beam_beats
from sim_player.trace.path_table import Paths


class ForeignPlayer(ScenePlayer):
    """A player whose paths to objects, of two reflections at most, are those of the foreign tracer.

    Walls and the ground as echoes of their own, mixtures of two ways, antenna, sweep and receiver are ours; what the
    foreign tracer does not know (diffraction, roughness, foliage, transmission, clutter) is not there. Raises
    `ValueError` for a scene that moves, `ForeignTracerMissingError` without the tracer.
    """

    def __init__(self, scene: Scene, seed: int = 0, setup: RadarSetup | None = None) -> None:
        self._foreign: Paths | None = None
        super().__init__(scene, seed, setup, effects="all")

    def paths(self, time_s: float) -> Paths:
        """Return all paths; at any time the same."""
        if self._foreign is None:
            self._foreign = self._trace_foreign()
        return self._foreign

    def _trace_foreign(self) -> Paths:
        if self.scene.moves:
            raise ValueError(f"scene {self.scene.name}: a foreign world is at rest, this one moves")
        view = snapshot(clear_of_bodies(self._world))
        surfaces = exported_surfaces(view.world)
        one_way_paths = trace_to_points(surfaces, view.antenna, view.centre, view.world.radar.carrier_hz)
        one_way_paths = one_way_paths.take(~meets_own_object(one_way_paths, surfaces, view.world.centre_object))
        return foreign_paths(view, as_routes(one_way_paths, surfaces), ALL_EFFECTS)

    def _all_beats(self) -> np.ndarray:
        """Return the echoes of every beam, complex128 [beams, samples]."""
        return beam_beats(self.setup, self.paths(0.0), self.signal, self.scene.radar.front_end)
