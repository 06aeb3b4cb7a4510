"""Raw beams of random places with their labels, for evaluations of the whole chain from samples to positions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

from msgs.values.radar import RadarBeam
from msgs.values.units import ratio_from_db
from sim_player.dataset.labelled_scan import Labels, label_points, stronger
from sim_player.dataset.shards import draw_gain_db, scene_seed
from sim_player.generate.places import draw_place
from sim_player.player import ScenePlayer
from sim_player.trace.truth import hidden_objects


@dataclass(frozen=True)
class LabelledPlace:
    """A random place under the default radar: number `index` of the series of a seed, as data sets draw it."""

    seed: int
    index: int
    effects: str = "auto"
    #: Radar and road users move, as `sim_player.generate.places.random_place` sets them in motion.
    moving: bool = False

    @cached_property
    def player(self) -> ScenePlayer:
        """Player of its beams; a scan takes some tenths of a second."""
        scene = draw_place(self.seed, self.index, "xband", None, self.moving).scene
        setup = stronger(scene.setup, ratio_from_db(draw_gain_db(self.seed, self.index)))
        return ScenePlayer(scene, scene_seed(self.seed, self.index), setup, effects=self.effects)

    def beams(self) -> Iterator[RadarBeam]:
        """Yield the beams of one scan, in order."""
        return (self.player.beam(0, index) for index in range(len(self.player.setup.beams)))

    @cached_property
    def labels(self) -> Labels:
        """Its truth points."""
        classes = tuple(scene_object.object_class for scene_object in self.player.scene.objects)
        return label_points(self.player.setup, self.player.paths(0.0), 1.0, classes)

    @cached_property
    def hidden(self) -> tuple[int, ...]:
        """Objects seen in a mirror and not directly."""
        return tuple(sorted(hidden_objects(self.player.paths(0.0))))
