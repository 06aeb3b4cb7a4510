"""Raw beams of random places with their labels, for evaluations of the whole chain from samples to positions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import msgspec
import numpy as np

from msgs.values.radar import RadarBeam
from msgs.values.units import ratio_from_db
from sim_player.dataset.labelled_scan import Labels, label_points
from sim_player.dataset.shards import GAIN_DB, scene_seed
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
        gain_db = np.random.default_rng([self.seed, self.index, 7]).uniform(-GAIN_DB, GAIN_DB)
        power_w = ratio_from_db(gain_db) * scene.setup.radar.transmit_power_w
        radar = msgspec.structs.replace(scene.setup.radar, transmit_power_w=power_w)
        setup = msgspec.structs.replace(scene.setup, radar=radar)
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
