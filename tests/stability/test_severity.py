"""Two scenes under mild and severe faults of the hardware: mild ones cost nothing, severe ones are never silent.

Faults act where they arise; the chain knows only the radar's set-up. The draws of a scene and fault are the same at
every severity, only scaled.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from functools import cache, lru_cache

import msgspec
import numpy as np
import pytest

from benchmarks.accuracy.six_scenes import SCENES
from models.perception.chain import Chain
from models.perception.find.detectors import NetworkDetector
from models.perception.find.maps_to_peaks import DetectionStage
from models.perception.form.beams_to_maps import FormingStage
from models.perception.track.views_over_scans import ViewStage
from models.physics.antenna import setup_weights
from models.scores.object_matching import match_objects
from msgs.values.perception import BevFrame, SceneTruth
from msgs.values.radar import RadarBeam, RadarSetup
from sim_player.player import ScenePlayer
from sim_player.scene.description import Scene, load_scene

TWO = [scene for scene in SCENES if scene.stem in ("oblique_container", "two_hidden_vehicles")]


class Hardware:
    """A radar as it really is; the faults of one case are done to it."""

    def __init__(self, scene: Scene, fault: str) -> None:
        self.setup: RadarSetup = scene.setup
        #: What becomes of each beam on its way to the chain.
        self.spoil: Callable[[RadarBeam], RadarBeam] = lambda beam: beam
        self.rng = np.random.default_rng([0, zlib.crc32(scene.name.encode()), zlib.crc32(fault.encode())])

    def weigh(self, columns: np.ndarray) -> None:
        """Multiply the weights of the columns, [columns] or [beams, columns]."""
        weights = (setup_weights(self.setup) * columns).astype(np.complex64)
        self.setup = msgspec.structs.replace(self.setup, steering_weights=weights)


def mute_beams(radar: Hardware, count: float) -> None:
    """Let beams hold noise alone: the array did not radiate."""
    beams = len(radar.setup.beams)
    radiates = np.ones((beams, 1))
    radiates[radar.rng.permutation(beams)[: int(count)]] = 0.0
    radar.weigh(radiates)


def phase_errors(radar: Hardware, rms_deg: float) -> None:
    """Put phases of the columns off by a normal draw."""
    radar.weigh(np.exp(1j * np.radians(rms_deg) * radar.rng.standard_normal(radar.setup.array.columns)))


def missing_chirps(radar: Hardware, percent: float) -> None:
    """Lose chirps of every beam on the link, zeros in their place."""
    chirps = radar.setup.radar.chirps_per_beam
    lost = np.stack([radar.rng.permutation(chirps) for _ in range(len(radar.setup.beams))])
    lost = lost[:, : round(percent / 100.0 * chirps)]

    def spoil(beam: RadarBeam) -> RadarBeam:
        samples = beam.samples.copy()
        samples[lost[beam.beam_index]] = 0
        return msgspec.structs.replace(beam, samples=samples)

    radar.spoil = spoil


#: Mild, severe, and the flag that a severe fault must raise.
CASES = {
    phase_errors: (10.0, 60.0, "array_error"),
    mute_beams: (2.0, 12.0, "silent_beams"),
    missing_chirps: (25.0, 97.0, "lost_chirps"),
}


@cache
def scene_of(name: str) -> Scene:
    return load_scene(next(scene for scene in TWO if scene.stem == name))


@lru_cache
def detector(radar_height_m: float) -> NetworkDetector:
    """The network for the radar as stated, which is the same in both scenes but for its height."""
    return NetworkDetector(RadarSetup(radar_height_m=radar_height_m))


def view_of(radar: Hardware, scene: Scene) -> tuple[BevFrame, SceneTruth]:
    """One scan through a chain that holds the radar for what its set-up says."""
    player = ScenePlayer(scene, 0, radar.setup, effects="basic")
    chain = Chain(FormingStage(), DetectionStage(lambda setup: detector(setup.radar_height_m)), ViewStage())
    chain.set_up(scene.setup)
    beams = [radar.spoil(player.beam(0, index)) for index in range(len(scene.setup.beams))]
    (view,) = [view for beam in beams for view in chain.add(beam)]
    return view.frame, player.truth(0)


@pytest.mark.parametrize("name", [scene.stem for scene in TWO])
def test_a_sound_radar_raises_no_flag(name: str) -> None:
    frame, truth = view_of(Hardware(scene_of(name), "none"), scene_of(name))
    match = match_objects(frame.objects, truth)
    assert (match.missed_truths, match.unmatched_objects, list(frame.flags)) == ((), (), [])


@pytest.mark.slow
@pytest.mark.parametrize("fault", CASES, ids=lambda fault: fault.__name__)
@pytest.mark.parametrize("name", [scene.stem for scene in TWO])
def test_mild_faults_keep_every_vehicle_and_severe_ones_are_flagged(
    name: str, fault: Callable[[Hardware, float], None]
) -> None:
    """Found means within 1 m."""
    mild, severe, flag = CASES[fault]
    radar = Hardware(scene_of(name), fault.__name__)
    fault(radar, mild)
    frame, truth = view_of(radar, scene_of(name))
    match = match_objects(frame.objects, truth)
    assert (match.missed_truths, match.unmatched_objects) == ((), ())
    assert len(match.matched) > 0
    radar = Hardware(scene_of(name), fault.__name__)
    fault(radar, severe)
    frame, _ = view_of(radar, scene_of(name))
    assert flag in frame.flags
