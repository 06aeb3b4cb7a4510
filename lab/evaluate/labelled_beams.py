"""Raw beams of random places with their labels, for evaluations of the whole chain from samples to positions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from lab.foreign.foreign_player import ForeignPlayer
from msgs.values.radar import PRESETS, RadarBeam
from msgs.values.units import ratio_from_db
from sim_player.dataset.domain_shift import BoardFaults, Shift, domain_shifted_scene, draw_faults
from sim_player.dataset.labelled_scan import Labels, label_points, stronger
from sim_player.dataset.shards import draw_gain_db, scene_seed, shift_rng
from sim_player.generate.drives import draw_drive
from sim_player.generate.places import draw_place
from sim_player.paths.truth import hidden_objects
from sim_player.player import ScenePlayer
from sim_player.scene.description import Scene
from sim_player.signal.levels import Terms

#: Tracer of a place.
TracedBy = Literal["own", "foreign"]


class FaultyBoardPlayer(ScenePlayer):
    """A player whose board has faults: the echoes of a beam times its gain, the receiver's noise as it was."""

    def __init__(self, *args: Any, faults: BoardFaults, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.faults = faults

    def echoes(self, scan: int, index: int) -> Terms:
        """Return the terms of one beam's echoes as the board's own gain leaves them."""
        beats, carrier, basis = super().echoes(scan, index)
        return self.faults.gain[index] * beats, carrier, basis


@dataclass(frozen=True)
class LabelledPlace:
    """A random place under the default radar: number `index` of the series of a seed, as data sets draw it."""

    seed: int
    index: int
    effects: str = "auto"
    #: Radar and road users move, as `sim_player.generate.places.random_place` sets them in motion.
    moving: bool = False
    #: More than one: a drive of so many scans (`sim_player.generate.drives`), which moves in any case.
    scans: int = 1
    #: As of `sim dataset --shift`: rougher and fuller, seen by a board with faults, whose dead beams never come.
    shift: Shift = "none"
    #: "foreign": objects are reached by the paths of another tracer (`lab.foreign.foreign_player`), at rest.
    world: TracedBy = "own"

    @property
    def scene(self) -> Scene:
        """The scene alone, without paths."""
        if self.scans > 1:
            duration_s = self.scans * PRESETS["xband"].radar.scan_period_s
            scene = draw_drive(self.seed, self.index, "xband", duration_s).scene
        else:
            scene = draw_place(self.seed, self.index, "xband", None, self.moving).scene
        return scene if self.shift == "none" else domain_shifted_scene(scene, shift_rng(self.seed, self.index, 0))

    @cached_property
    def player(self) -> ScenePlayer:
        """Player of its beams; a scan takes some tenths of a second."""
        scene, seed = self.scene, scene_seed(self.seed, self.index)
        setup = stronger(scene.setup, ratio_from_db(draw_gain_db(self.seed, self.index)))
        if self.world == "foreign":
            return ForeignPlayer(scene, seed, setup)
        if self.shift == "none":
            return ScenePlayer(scene, seed, setup, effects=self.effects, purpose="objects", walls_stop=False)
        faults = draw_faults(shift_rng(self.seed, self.index, 1), len(setup.beams))
        return FaultyBoardPlayer(
            scene, seed, setup, effects=self.effects, purpose="objects", walls_stop=False, faults=faults
        )

    def beams(self, scan: int = 0) -> Iterator[RadarBeam]:
        """Yield the beams of one scan that come, in order."""
        player = self.player
        dead = player.faults.dead if isinstance(player, FaultyBoardPlayer) else ()
        return (player.beam(scan, index) for index in range(len(player.setup.beams)) if not (len(dead) and dead[index]))

    @cached_property
    def labels(self) -> Labels:
        """Its truth points."""
        classes = tuple(scene_object.object_class for scene_object in self.player.scene.objects)
        return label_points(self.player.setup, self.player.paths(0.0), 1.0, classes, self.player.clutter_mw(0))

    @cached_property
    def hidden(self) -> tuple[int, ...]:
        """Objects seen in a mirror and not directly."""
        return tuple(sorted(hidden_objects(self.player.paths(0.0))))
