"""A scene played as a radar: beams in order of acquisition, truth, and the vehicle's own motion."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from msgs.perception import SceneTruth
from msgs.radar import RadarBeam, RadarSetup
from msgs.units import ns_from_s, s_from_ns
from msgs.vehicle import VehicleState
from sim_player.fmcw import beam_codes, beam_weights, chirp_beats, noise_bank, slow_time_terms
from sim_player.ray_tracing import Paths, prepare, trace
from sim_player.scene import Scene
from sim_player.truth import scene_truth


class ScenePlayer:
    """Beams and truth of a scene at any scan, in any order: same seed, same bytes.

    `setup` replaces the scene's preset; `chirps_per_beam` shortens the beams; `phase_jitter_rad` turns each beam by
    a random phase of this standard deviation (a radar that loses coherence between beams). Scans count from
    `start_ns`, beams are spread evenly over the scan period. Raises ValueError for a scene that cannot be simulated.
    """

    def __init__(
        self,
        scene: Scene,
        seed: int = 0,
        setup: RadarSetup | None = None,
        start_ns: int = 0,
        phase_jitter_rad: float = 0.0,
        chirps_per_beam: int | None = None,
    ) -> None:
        setup = scene.setup if setup is None else setup
        if chirps_per_beam is not None:
            shorter = msgspec.structs.replace(setup.radar, chirps_per_beam=chirps_per_beam)
            setup = msgspec.structs.replace(setup, radar=shorter)
        if not (math.isfinite(phase_jitter_rad) and phase_jitter_rad >= 0.0):
            raise ValueError(f"phase_jitter_rad must be finite and not negative, got {phase_jitter_rad!r}")
        self.scene = scene
        self.setup = msgspec.structs.replace(setup, stamp_ns=start_ns)
        self._seed = seed
        self._phase_jitter_rad = phase_jitter_rad
        self._world = prepare(scene, seed, setup)
        self._bank = noise_bank(setup.radar, seed)
        self._still_beats = None if scene.moves else self._all_beats(self.paths(0.0))

    def stamp_ns(self, scan: int, beam: int = 0) -> int:
        """When a beam starts."""
        period_ns = ns_from_s(self.setup.radar.scan_period_s)
        return self.setup.stamp_ns + scan * period_ns + beam * self.setup.beam_interval_ns

    def paths(self, time_s: float) -> Paths:
        """All paths at a time after start."""
        return trace(self._world, time_s)

    def beam(self, scan: int, index: int) -> RadarBeam:
        """One steering angle's raw samples, as measured at its time."""
        stamp_ns = self.stamp_ns(scan, index)
        beats, carrier, basis = self._beats(stamp_ns, index)
        if self._phase_jitter_rad:
            rng = np.random.default_rng([self._seed, 4, scan, index])
            carrier = carrier * np.exp(1j * self._phase_jitter_rad * rng.standard_normal())
        return RadarBeam(
            stamp_ns=stamp_ns,
            scan_id=scan,
            beam_index=index,
            beam_count=len(self.setup.beams),
            azimuth_rad=float(self.setup.beams.azimuth_rad[index]),
            samples=beam_codes(self.setup, beats, carrier, basis, self._bank, [self._seed, 5, scan, index]),
            full_scale_dbm=self.setup.full_scale_dbm,
        )

    def truth(self, scan: int) -> SceneTruth:
        """What is there when a scan starts."""
        stamp_ns = self.stamp_ns(scan)
        time_s = self._elapsed_s(stamp_ns)
        return scene_truth(self._world, self.setup, self.paths(time_s), time_s, stamp_ns, scan)

    def vehicle_state(self, stamp_ns: int) -> VehicleState:
        """The vehicle's constant motion, as its bus would report it."""
        ego = self.scene.ego
        return VehicleState(stamp_ns=stamp_ns, speed_mps=ego.speed_mps, yaw_rate_rps=math.radians(ego.yaw_rate_dps))

    def _elapsed_s(self, stamp_ns: int) -> float:
        return s_from_ns(stamp_ns - self.setup.stamp_ns)

    def _all_beats(self, paths: Paths) -> np.ndarray:
        """Beats of every beam of a scene at rest, complex128 [beams, samples]."""
        return chirp_beats(self.setup.radar, paths.length_m, beam_weights(self.setup, paths))

    def _beats(self, stamp_ns: int, index: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Terms of one beam: beats [terms, samples], carrier [chirps], basis [terms, chirps]."""
        radar = self.setup.radar
        if self._still_beats is not None:
            ones = np.ones(radar.chirps_per_beam)
            return self._still_beats[index : index + 1], ones, ones[None]
        # slow time counts from the middle of the beam, so the scene is frozen there
        paths = self.paths(self._elapsed_s(stamp_ns) + 0.5 * (radar.beam_duration_s - radar.chirp_period_s))
        carrier, basis, share = slow_time_terms(radar, paths.radial_speed_mps)
        weights = beam_weights(self.setup, paths, slice(index, index + 1))
        return chirp_beats(radar, paths.length_m, share * weights), carrier, basis
