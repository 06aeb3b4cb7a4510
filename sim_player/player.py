"""Player of a scene as a radar: beams in order of acquisition, truth, and the vehicle's own motion."""

from __future__ import annotations

import math
from functools import cached_property

import msgspec
import numpy as np

from msgs.values.perception import SceneTruth
from msgs.values.radar import RadarBeam, RadarSetup
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.vehicle import VehicleState
from sim_player.paths.path_tracks import PathTrack, scene_step_s
from sim_player.paths.ray_tracing import BASIC_EFFECTS, trace
from sim_player.paths.truth import scene_truth
from sim_player.planner.plan import BUDGET_DB, Plan, resolve_plan
from sim_player.planner.purposes import purpose_of
from sim_player.scene.clear_path import ego_meeting, meeting_text
from sim_player.scene.description import Scene
from sim_player.scene.world import prepare, snapshot
from sim_player.signal.clutter import Clutter, drawn_cells, profile_power_mw, with_clutter
from sim_player.signal.fmcw import noise_bank
from sim_player.signal.levels import Terms, echo_terms, group_beats, record_beam, with_electronics
from sim_player.signal.rain_volume import clutter_at
from sim_player.signal.swept_echoes import check_precision
from sim_player.signal.switches import PLAIN, SignalEffects
from sim_player.trace.path_table import Paths


class ScenePlayer:
    """Beams and truth of a scene at any scan, in any order: same seed, same bytes.

    `setup` replaces the scene's preset; `chirps_per_beam` shortens the beams; `phase_jitter_rad` turns each beam by
    a random phase of this standard deviation (a radar that loses coherence between beams). Scans count from
    `start_ns`, beams are spread evenly over the scan period, those of a digital array are of one time. Raises
    ValueError for a scene that cannot be simulated, and once its radar has driven into a wall.

    `effects`: "basic" (direct echoes and single mirrors), "auto" (the effects that the scene needs for a `purpose`
    under `budget_db`, planned once), "all", or names with commas between them. What moves is traced at instants between
    which it moves little (`sim_player.paths.path_tracks`), its echoes have `precision` ("float32", "float64"); "auto"
    leaves out its weakest paths, chosen from one instant to the next.
    """

    def __init__(
        self,
        scene: Scene,
        seed: int = 0,
        setup: RadarSetup | None = None,
        start_ns: int = 0,
        phase_jitter_rad: float = 0.0,
        chirps_per_beam: int | None = None,
        effects: str = "basic",
        budget_db: float = BUDGET_DB,
        precision: str = "float32",
        purpose: str = "samples",
    ) -> None:
        check_precision(precision)
        setup = scene.setup if setup is None else setup
        if chirps_per_beam is not None:
            shorter = msgspec.structs.replace(setup.radar, chirps_per_beam=chirps_per_beam)
            setup = msgspec.structs.replace(setup, radar=shorter)
        if not (math.isfinite(phase_jitter_rad) and phase_jitter_rad >= 0.0):
            raise ValueError(f"phase_jitter_rad must be finite and not negative, got {phase_jitter_rad!r}")
        self.scene = scene
        self.setup = msgspec.structs.replace(setup, stamp_ns=start_ns)
        self._meeting = ego_meeting(scene)
        self._seed = seed
        self._phase_jitter_rad = phase_jitter_rad
        self._world = prepare(scene, seed, setup)
        self._precision = precision
        # a plan holds while nothing moves; of a moving scene its effects hold, its weakest paths are chosen as it goes
        self._plan = resolve_plan(self._world, self.setup, effects, budget_db, purpose=purpose_of(purpose))
        self._track: tuple[frozenset[str], PathTrack] | None = None
        self._traced: dict[tuple[float, int], Paths] = {}
        self._drawn: tuple[int, Clutter, np.ndarray] | None = None
        self._still_beats = None if scene.moves else self._all_beats()

    @cached_property
    def _bank(self) -> np.ndarray:
        """The white noise that beams read."""
        return noise_bank(self.setup.radar, self._seed)

    def stamp_ns(self, scan: int, beam: int = 0) -> int:
        """Return when a beam starts."""
        period_ns = ns_from_s(self.setup.radar.scan_period_s)
        return self.setup.stamp_ns + scan * period_ns + beam * self.setup.beam_interval_ns

    def described(self) -> dict[str, str]:
        """Return what the beams were made of, for people: effects, and what a plan was for."""
        plan = self._plan
        if plan is None:
            return {"effects": "basic"}
        made = {"effects": " ".join(sorted(plan.used))}
        if math.isinf(plan.budget_db):
            return made
        return made | {"for": str(plan.purpose), "budget_db": f"{plan.budget_db:g}"}

    def plan(self, scan: int) -> Plan | None:
        """Return the effects of a scan as planned at the start; None: the basic ones, without a plan."""
        return self._plan

    def paths(self, time_s: float, scan: int = 0) -> Paths:
        """Return all paths at a time after start, under the effects of a scan."""
        if (time_s, scan) not in self._traced:
            plan = self.plan(scan)
            # only the last ones are kept: those of all beams of a digital array
            self._traced = {(time_s, scan): trace(self._world, time_s, BASIC_EFFECTS if plan is None else plan.present)}
        return self._traced[time_s, scan]

    def beam(self, scan: int, index: int) -> RadarBeam:
        """Return one steering angle's raw samples, as measured at its time."""
        stamp_ns, seed = self.stamp_ns(scan, index), [self._seed, 5, scan, index]
        signal, front_end = self.signal(scan), self.scene.radar.front_end
        beats, carrier, basis = with_electronics(self.setup, self.echoes(scan, index), signal, front_end, seed)
        if self._phase_jitter_rad:
            rng = np.random.default_rng([self._seed, 4, scan, index])
            carrier = carrier * np.exp(1j * self._phase_jitter_rad * rng.standard_normal())
        return RadarBeam(
            stamp_ns=stamp_ns,
            scan_id=scan,
            beam_index=index,
            beam_count=len(self.setup.beams),
            azimuth_rad=float(self.setup.beams.azimuth_rad[index]),
            samples=record_beam(self.setup, (beats, carrier, basis), self._bank, seed, signal, front_end),
            full_scale_dbm=self.setup.full_scale_dbm,
        )

    def truth(self, scan: int) -> SceneTruth:
        """Return the truth at the start of a scan."""
        return self.truth_at(self.stamp_ns(scan), scan)

    def truth_at(self, stamp_ns: int, scan: int) -> SceneTruth:
        """Return the truth at a time, under the effects of a scan."""
        time_s = self._elapsed_s(stamp_ns)
        clutter_mw = self.clutter_mw(scan)
        return scene_truth(
            self._world, self.setup, self.paths(time_s, scan), time_s, stamp_ns, scan, clutter_mw=clutter_mw
        )

    def vehicle_state(self, stamp_ns: int) -> VehicleState:
        """Return the vehicle's constant motion, as its bus would report it."""
        ego = self.scene.ego
        return VehicleState(stamp_ns=stamp_ns, speed_mps=ego.speed_mps, yaw_rate_rps=math.radians(ego.yaw_rate_dps))

    def _used(self, scan: int) -> frozenset[str]:
        """Return the effects of the paths of a scan."""
        plan = self.plan(scan)
        return BASIC_EFFECTS if plan is None else plan.used

    def _tracked(self, scan: int) -> PathTrack:
        """Return the paths of moving things under the effects of a scan."""
        plan, used = self.plan(scan), self._used(scan)
        kept = None if plan is None or plan.spans is None else plan.spans.kept
        if self._track is None or self._track[0] != used:
            track = PathTrack(lambda time_s: trace(self._world, time_s, used), scene_step_s(self._world), kept)
            self._track = used, track
        return self._track[1]

    def _elapsed_s(self, stamp_ns: int) -> float:
        """Return the time since the start; ValueError once the radar has met a wall."""
        time_s = s_from_ns(stamp_ns - self.setup.stamp_ns)
        if self._meeting is not None and time_s > self._meeting[0]:
            raise ValueError(f"scene {self.scene.name!r}: {meeting_text(self._meeting)}, asked for {time_s:.2f} s")
        return time_s

    def signal(self, scan: int) -> SignalEffects:
        """Return the antenna, waveform and receiver of a scan."""
        plan = self.plan(scan)
        return PLAIN if plan is None else plan.signal

    def _all_beats(self) -> np.ndarray:
        """Return the echoes of every beam of a scene at rest, complex [beams, samples]."""
        plan = self.plan(0)
        groups = [(self.paths(0.0), self.signal(0))] if plan is None else plan.groups()
        precision = "float64" if plan is None else plan.precision
        return group_beats(self.setup, groups, self.scene.radar.front_end, precision=precision)

    def beam_paths(self, scan: int, index: int) -> Paths:
        """Return the paths of one beam, frozen at its middle, from where slow time counts."""
        radar = self.setup.radar
        middle_s = 0.5 * (radar.beam_duration_s - radar.chirp_period_s)
        return self._tracked(scan).at(self._elapsed_s(self.stamp_ns(scan, index)) + middle_s)

    def echoes(self, scan: int, index: int) -> Terms:
        """Return the terms of one beam's echoes: beats [terms, samples], carrier [chirps], basis [terms, chirps]."""
        terms, signal = self._path_echoes(scan, index), self.signal(scan)
        if not signal.rain_clutter:
            return terms
        clutter, cells = self._air(scan)
        return with_clutter(self.setup, terms, clutter, cells[index], index)

    def _air(self, scan: int) -> tuple[Clutter, np.ndarray]:
        """Return the echoes of rain, snow and fog around the radar at the start of a scan, and their draws."""
        if self._drawn is None or self._drawn[0] != scan:
            signal, front_end = self.signal(scan), self.scene.radar.front_end
            if self._drawn is None or self.scene.moves:
                clutter = clutter_at(snapshot(self._world, self._elapsed_s(self.stamp_ns(scan))), signal)
            else:
                clutter = self._drawn[1]
            self._drawn = scan, clutter, drawn_cells(self.setup, clutter, signal, front_end, self._seed, scan)
        return self._drawn[1:]

    def clutter_mw(self, scan: int) -> np.ndarray | None:
        """Return the mean power of the air's echoes in a scan, mW, [beams, bins]; None where there are none."""
        signal = self.signal(scan)
        if not signal.rain_clutter:
            return None
        return profile_power_mw(self.setup, self._air(scan)[0], signal, self.scene.radar.front_end)

    def _path_echoes(self, scan: int, index: int) -> Terms:
        """Return the same of the paths alone."""
        if self._still_beats is not None:
            unit = np.ones(self.setup.radar.chirps_per_beam)
            return self._still_beats[index : index + 1], unit, unit[None]
        paths, front_end = self.beam_paths(scan, index), self.scene.radar.front_end
        return echo_terms(self.setup, paths, self.signal(scan), front_end, index, self._precision)
