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
from sim_player.drive import Drive
from sim_player.paths.conversion import as_paths
from sim_player.paths.path_tracks import PathTrack, tracing_step_s
from sim_player.paths.ray_tracing import BASIC_EFFECTS, trace_echoes
from sim_player.paths.reach import reachable_snapshot
from sim_player.paths.truth import scene_truth
from sim_player.planner.plan import BUDGET_DB, resolve_plan
from sim_player.planner.purposes import purpose_of
from sim_player.scene.clear_path import ego_meeting, require_unmet
from sim_player.scene.description import Ego, Scene
from sim_player.scene.world import RadarState, prepare, scene_radar, snapshot
from sim_player.signal.clutter import Clutter, drawn_cells, profile_power_mw, with_clutter
from sim_player.signal.fmcw import noise_bank
from sim_player.signal.levels import Terms, beam_beats, echo_terms, record_beam, with_electronics
from sim_player.signal.rain_volume import clutter_at
from sim_player.signal.swept_echoes import check_precision
from sim_player.signal.switches import PLAIN
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
    leaves out each beam's weakest paths. `noise_seed` draws the receiver's noise of one of several radars that look at
    one world; None: `seed` does.

    `drive` moves the radar in place of the scene's `ego`, which then must stand still; the planner knows no drive:
    ValueError for "auto". `walls_stop` false: drawn drives are played to their end, also the few that cross a wall.
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
        drive: Drive | None = None,
        walls_stop: bool = True,
        noise_seed: int | None = None,
    ) -> None:
        check_precision(precision)
        if drive is not None and scene.ego != Ego():
            raise ValueError(f"scene {scene.name!r}: ego must stand still: the drive says how the vehicle moves")
        if drive is not None and effects == "auto":
            raise ValueError("effects must be basic, all or names with commas between them on a drive, got 'auto'")
        setup = scene.setup if setup is None else setup
        if chirps_per_beam is not None:
            shorter = msgspec.structs.replace(setup.radar, chirps_per_beam=chirps_per_beam)
            setup = msgspec.structs.replace(setup, radar=shorter)
        if not (math.isfinite(phase_jitter_rad) and phase_jitter_rad >= 0.0):
            raise ValueError(f"phase_jitter_rad must be finite and not negative, got {phase_jitter_rad!r}")
        self.scene, self.drive = scene, drive
        self.setup = msgspec.structs.replace(setup, stamp_ns=start_ns)
        self._moves = drive is not None or scene.moves
        self._seed = seed if noise_seed is None else noise_seed
        self._phase_jitter_rad = phase_jitter_rad
        self._world = prepare(scene, seed, setup)
        # of a scene that is good
        self._meeting = None
        if walls_stop:
            self._meeting = ego_meeting(scene) if drive is None else drive.meeting(scene)
        self._precision = precision
        #: Effects as planned at the start, None: the basic ones. Of a moving scene its weakest paths are chosen later.
        self.plan = resolve_plan(self._world, self.setup, effects, budget_db, purpose=purpose_of(purpose))
        #: Antenna, waveform and receiver.
        self.signal = PLAIN if self.plan is None else self.plan.signal
        self._traced: tuple[float, Paths] | None = None
        self._drawn: tuple[int, Clutter, np.ndarray] | None = None
        self._still_beats = None if self._moves else self._all_beats()

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
        if self.plan is None:
            return {"effects": "basic"}
        made = {"effects": " ".join(sorted(self.plan.used))}
        if math.isinf(self.plan.budget_db):
            return made
        return made | {"for": str(self.plan.purpose), "budget_db": f"{self.plan.budget_db:g}"}

    def radar(self, time_s: float) -> RadarState:
        """Return the radar's pose and velocity in the scene's frame at a time after start."""
        return scene_radar(self.scene, time_s) if self.drive is None else self.drive.radar(time_s)

    def paths(self, time_s: float) -> Paths:
        """Return all paths at a time after start; those of the last time are kept."""
        if self._traced is None or self._traced[0] != time_s:
            present = BASIC_EFFECTS if self.plan is None else self.plan.present
            self._traced = time_s, self._trace(time_s, present)
        return self._traced[1]

    def _trace(self, time_s: float, effects: frozenset[str]) -> Paths:
        if time_s == 0.0 and self._moves and self.drive is None and self.plan and effects == self.plan.present:
            # a plan of a scene that moves holds all paths of its start
            return self.plan.paths
        view = reachable_snapshot(self._world, time_s, self.radar(time_s))
        return as_paths(view, trace_echoes(view, effects), effects)

    def beam(self, scan: int, index: int) -> RadarBeam:
        """Return one steering angle's raw samples, as measured at its time."""
        stamp_ns, seed = self.stamp_ns(scan, index), [self._seed, 5, scan, index]
        front_end = self.scene.radar.front_end
        beats, carrier, basis = with_electronics(self.setup, self.echoes(scan, index), self.signal, front_end, seed)
        if self._phase_jitter_rad:
            rng = np.random.default_rng([self._seed, 4, scan, index])
            carrier = carrier * np.exp(1j * self._phase_jitter_rad * rng.standard_normal())
        return RadarBeam(
            stamp_ns=stamp_ns,
            scan_id=scan,
            beam_index=index,
            beam_count=len(self.setup.beams),
            azimuth_rad=float(self.setup.beams.azimuth_rad[index]),
            samples=record_beam(self.setup, (beats, carrier, basis), self._bank, seed, self.signal, front_end),
            full_scale_dbm=self.setup.full_scale_dbm,
        )

    def truth(self, scan: int) -> SceneTruth:
        """Return the truth at the start of a scan, in the radar's frame."""
        stamp_ns = self.stamp_ns(scan)
        time_s, clutter_mw = self._elapsed_s(stamp_ns), self.clutter_mw(scan)
        paths, pose = self.paths(time_s), self.radar(time_s).pose
        return scene_truth(self._world, self.setup, paths, time_s, stamp_ns, scan, pose, clutter_mw)

    def vehicle_state(self, stamp_ns: int) -> VehicleState:
        """Return the vehicle's motion, as its bus would report it."""
        if self.drive is not None:
            return self.drive.state(stamp_ns, s_from_ns(stamp_ns - self.setup.stamp_ns))
        ego = self.scene.ego
        return VehicleState(stamp_ns=stamp_ns, speed_mps=ego.speed_mps, yaw_rate_rps=math.radians(ego.yaw_rate_dps))

    @cached_property
    def _track(self) -> PathTrack:
        """The paths of what moves."""
        used = BASIC_EFFECTS if self.plan is None else self.plan.used
        own_mps = self.scene.ego.speed_mps if self.drive is None else self.drive.fastest_mps
        step_s = tracing_step_s(self._world, own_mps, self.setup.radar.scan_period_s)
        return PathTrack(lambda time_s: self._trace(time_s, used), step_s)

    def _elapsed_s(self, stamp_ns: int) -> float:
        """Return the time since the start; ValueError once the radar has met a wall."""
        time_s = s_from_ns(stamp_ns - self.setup.stamp_ns)
        require_unmet(self.scene, self._meeting, time_s)
        return time_s

    def _all_beats(self) -> np.ndarray:
        """Return the echoes of every beam of a scene at rest, complex [beams, samples]."""
        if self.plan is None:
            return beam_beats(self.setup, self.paths(0.0), self.signal, self.scene.radar.front_end)
        return self.plan.beats()

    def beam_paths(self, scan: int, index: int) -> Paths:
        """Return the paths of one beam, frozen at its middle, from where slow time counts."""
        radar = self.setup.radar
        middle_s = 0.5 * (radar.beam_duration_s - radar.chirp_period_s)
        return self._track.at(self._elapsed_s(self.stamp_ns(scan, index)) + middle_s)

    def load_kernels(self) -> None:
        """Load the compiled code that any beam may need, by the first one with all its paths."""
        if self._still_beats is None:
            echo_terms(self.setup, self.beam_paths(0, 0), self.signal, precision=self._precision)

    def echoes(self, scan: int, index: int) -> Terms:
        """Return the terms of one beam's echoes: beats [terms, samples], carrier [chirps], basis [terms, chirps]."""
        if self._still_beats is not None:
            unit = np.ones(self.setup.radar.chirps_per_beam)
            terms: Terms = self._still_beats[index : index + 1], unit, unit[None]
        else:
            paths, weakest = self.beam_paths(scan, index), None if self.plan is None else self.plan.weakest
            overlaps = None
            if weakest is not None:
                kept, overlaps = weakest.selected(paths, index)
                if not kept.all():
                    paths, overlaps = paths.take(kept), overlaps[kept]
            front_end = self.scene.radar.front_end
            terms = echo_terms(self.setup, paths, self.signal, front_end, index, self._precision, overlaps)
        if not self.signal.rain_clutter:
            return terms
        clutter, cells = self._air(scan)
        return with_clutter(self.setup, terms, clutter, cells[index], index)

    def _air(self, scan: int) -> tuple[Clutter, np.ndarray]:
        """Return the echoes of rain, snow and fog around the radar at the start of a scan, and their draws."""
        if self._drawn is None or self._drawn[0] != scan:
            if self._drawn is None or self._moves:
                time_s = self._elapsed_s(self.stamp_ns(scan))
                clutter = clutter_at(snapshot(self._world, time_s, self.radar(time_s)), self.signal)
            else:
                clutter = self._drawn[1]
            front_end = self.scene.radar.front_end
            self._drawn = scan, clutter, drawn_cells(self.setup, clutter, self.signal, front_end, self._seed, scan)
        return self._drawn[1:]

    def clutter_mw(self, scan: int) -> np.ndarray | None:
        """Return the mean power of the air's echoes in a scan, mW, [beams, bins]; None where there are none."""
        if not self.signal.rain_clutter:
            return None
        return profile_power_mw(self.setup, self._air(scan)[0], self.signal, self.scene.radar.front_end)
