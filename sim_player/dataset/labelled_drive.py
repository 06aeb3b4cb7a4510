"""Scans of a drive at the kernel level, with labels, truth and odometry: the records of a moving series.

Profiles are those that the RA former has after folding its beams. Labels say where the map shows an echo: each path at
the time of the beam that looks at it, carried to the scan's first pose as the former carries it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np

from models.perception.form.ra_forming import BeamFolder, EgoCorrection, FormingParams, beam_middle_s, ego_correction
from models.physics.waveform import window_noise_gain
from msgs.values.frames import Pose2, polar_from_xy
from msgs.values.perception import TruthObject
from msgs.values.radar import RadarSetup
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState, ego_motion
from sim_player.dataset.labelled_scan import BASIC_USED, WINDOW, Labels, label_points, without_converter
from sim_player.paths.truth import hidden_objects, labelled, visible_paths
from sim_player.planner.plan import Plan
from sim_player.player import ScenePlayer
from sim_player.scene.description import Scene
from sim_player.scene.world import radar_pose
from sim_player.signal.levels import RANGE_BINS, noise_density_mw, with_electronics
from sim_player.signal.slow_time_profiles import converter_objection, group_noise, group_profiles
from sim_player.signal.switches import SignalEffects
from sim_player.trace.path_table import Paths

#: Vehicle states of a scan, evenly over it: 50 Hz at the default radar.
STATES_PER_SCAN = 15
#: Errors of the bus, rms: of all states of a drive (tyres, a gyroscope's bias), and of each.
SPEED_SCALE, YAW_RATE_BIAS_RPS = 0.01, math.radians(0.3)
SPEED_NOISE_MPS, YAW_RATE_NOISE_RPS = 0.03, math.radians(0.2)


@dataclass(frozen=True)
class DriveScan:
    """One scan: profiles complex64 [beams, 512] with noise and ego motion taken out, labels and truth."""

    stamp_ns: int
    profiles: np.ndarray
    #: As the former measures it from these, over ground by the odometry; float32 [beams, 512], NaN in noise.
    radial_speed_mps: np.ndarray
    labels: Labels
    #: Of each label: over ground in the frame of the scan's first pose, float32 [N, 2]; when its beam looked, after the
    #: scan's stamp, float32 [N].
    velocity_mps: np.ndarray
    elapsed_s: np.ndarray
    #: All objects at the stamp in the radar's frame; `id` is their number in the scene, in every scan.
    objects: tuple[TruthObject, ...]
    #: Objects seen in a mirror and not directly.
    hidden: tuple[int, ...]
    #: The radar's pose at the stamp, in its frame at the start of the drive.
    start_from_radar: Pose2
    #: Vehicle states float64 [STATES_PER_SCAN, 3]: time after the stamp [s], speed [m/s], yaw rate [rad/s].
    odometry: np.ndarray
    #: Effects in the signal, paths of the beam ahead; effects planned at the scan's start, None: the basic ones.
    used: frozenset[str]
    paths: int
    plan: Plan | None


@dataclass(frozen=True)
class _Beam:
    """One beam: its paths, the former's correction, noiseless slow-time sums [groups, 512], a converter objection."""

    paths: Paths
    ego: EgoCorrection
    sums: np.ndarray
    objection: str | None


class LabelledDrive:
    """Scans of one scene in motion under the radar of `setup`, in any order, same bytes; `effects` as `ScenePlayer`."""

    def __init__(
        self,
        scene: Scene,
        seed: int,
        setup: RadarSetup,
        effects: str = "auto",
        budget_db: float = -20.0,
        purpose: str = "objects",
    ) -> None:
        self._player = ScenePlayer(
            scene, seed, setup, effects=effects, budget_db=budget_db, purpose=purpose, walls_stop=False
        )
        self._scene, self._setup, self._seed = scene, self._player.setup, seed
        self._folder = BeamFolder(self._setup, FormingParams(range_window=WINDOW), setup.map_grid)

    def scan(self, scan: int) -> DriveScan:
        """Return one scan of the drive."""
        odometry = self._odometry(scan)
        beams = list(self._beams(scan, state_of(odometry)))
        profiles, radial_speed_mps, objection = self._profiles(scan, beams)
        shown, elapsed_s = self._shown([beam.paths for beam in beams])
        visible = visible_paths(self._setup, shown, clutter_mw=self._player.clutter_mw(scan))
        classes = tuple(road_user.object_class for road_user in self._scene.objects)
        labels = label_points(self._setup, shown.take(visible), 1.0, classes)
        hidden = hidden_objects(shown)
        users = self._player.truth(scan).objects
        velocity_mps = np.array([*((user.velocity_x_mps, user.velocity_y_mps) for user in users), (0.0, 0.0)])
        return DriveScan(
            stamp_ns=self._player.stamp_ns(scan),
            profiles=profiles,
            radial_speed_mps=radial_speed_mps,
            labels=labels,
            # walls are number -1
            velocity_mps=velocity_mps[labels.object_index].astype(np.float32),
            elapsed_s=elapsed_s[visible].astype(np.float32),
            objects=tuple(msgspec.structs.replace(user, hidden=user.id in hidden) for user in users),
            hidden=tuple(sorted(hidden)),
            start_from_radar=radar_pose(self._scene, s_from_ns(self._player.stamp_ns(scan))),
            odometry=odometry,
            paths=len(beams[len(beams) // 2].paths),
            **self._plan(scan, objection),
        )

    def _plan(self, scan: int, objection: str | None) -> dict[str, Any]:
        """Return effects and plan of a scan, without a converter that its signal cannot hold."""
        plan = self._player.plan
        if plan is None:
            return {"used": BASIC_USED | ({"motion", "adc"} if objection is None else {"motion"}), "plan": None}
        plan = plan if objection is None else without_converter(plan, objection)
        return {"used": plan.used, "plan": plan}

    def _beams(self, scan: int, state: VehicleState) -> Iterator[_Beam]:
        """Yield the beams of a scan under a state of the vehicle."""
        signal, front_end = self._player.signal, self._scene.radar.front_end
        for beam in range(len(self._setup.beams)):
            ego = ego_correction(self._folder, beam, beam_middle_s(self._setup, beam), state)
            terms = self._player.echoes(scan, beam)
            terms = with_electronics(self._setup, terms, signal, front_end, [self._seed, 5, scan, beam])
            edges = self._folder.group_edges
            yield _Beam(
                paths=self._player.beam_paths(scan, beam),
                ego=ego,
                sums=group_profiles(self._setup, terms, edges, signal, front_end, ego.sample_phase),
                objection=converter_objection(self._setup, terms, signal, front_end) if signal.adc else None,
            )

    def _profiles(self, scan: int, beams: list[_Beam]) -> tuple[np.ndarray, np.ndarray, str | None]:
        """Return the profiles complex64 [beams, 512], their radial speeds, and why the converter is ideal."""
        objection = next((beam.objection for beam in beams if beam.objection is not None), None)
        signal, front_end = self._player.signal, self._scene.radar.front_end
        if objection is not None:
            signal = msgspec.structs.replace(signal, adc=False)
        floor_mw = self._floor_mw(signal)
        profiles = np.empty((len(beams), RANGE_BINS), np.complex64)
        radial_speed_mps = np.full(profiles.shape, np.nan, np.float32)
        for index, beam in enumerate(beams):
            seed, shift_bins = [self._seed, 5, scan, index], beam.ego.shift_m / self._setup.radar.range_bin_m
            noise = group_noise(self._setup, self._folder.group_edges, seed, signal, front_end, shift_bins)
            noisy = (beam.sums + noise).astype(np.complex64)
            profile, speed_mps = self._folder.resolved(noisy, floor_mw, beam.ego)
            profiles[index] = profile * beam.ego.bin_phase
            if speed_mps is not None:
                radial_speed_mps[index] = speed_mps
        return profiles, radial_speed_mps, objection

    def _floor_mw(self, signal: SignalEffects) -> float:
        """Return the noise power of a profile's bin where the former measures it, far from the carrier."""
        middle = np.array([self._setup.radar.samples_per_chirp // 2])
        density_mw = noise_density_mw(self._setup, middle, signal, self._scene.radar.front_end)
        return float(density_mw[0]) * window_noise_gain(WINDOW)

    def _shown(self, beams: list[Paths]) -> tuple[Paths, np.ndarray]:
        """Return the paths that can have labels, each by the beam that looks at it most directly, and when [s]."""
        beam_rad, ego = self._setup.beams.azimuth_rad, self._scene.ego
        parts, elapsed_s, off_rad = [], [], []
        for beam, paths in enumerate(beams):
            away_rad = np.abs(paths.azimuth_rad[:, None] - beam_rad)
            own = np.flatnonzero(labelled(paths) & (np.argmin(away_rad, axis=1) == beam))
            middle_s = beam_middle_s(self._setup, beam)
            pose = ego_motion(ego.speed_mps, math.radians(ego.yaw_rate_dps), middle_s)
            parts.append(carried(paths.take(own), pose))
            elapsed_s.append(np.full(len(own), middle_s))
            off_rad.append(away_rad[own, beam])
        shown = Paths.joined(parts)
        # a path that turns from one beam's share to the next one's can be seen by both
        order = np.argsort(np.concatenate(off_rad), kind="stable")
        once = np.sort(order[np.unique(shown.chain[order], return_index=True)[1]])
        return shown.take(once), np.concatenate(elapsed_s)[once]

    def _odometry(self, scan: int) -> np.ndarray:
        """Return the vehicle's states as its bus sends them, float64 [STATES_PER_SCAN, 3]."""
        whole = np.random.default_rng([self._seed, 21])
        scale, bias_rps = 1.0 + SPEED_SCALE * whole.standard_normal(), YAW_RATE_BIAS_RPS * whole.standard_normal()
        noise = np.random.default_rng([self._seed, 22, scan]).standard_normal((2, STATES_PER_SCAN))
        ego = self._scene.ego
        elapsed_s = np.arange(STATES_PER_SCAN) * (self._setup.radar.scan_period_s / STATES_PER_SCAN)
        speed_mps = scale * ego.speed_mps + SPEED_NOISE_MPS * noise[0]
        yaw_rate_rps = math.radians(ego.yaw_rate_dps) + bias_rps + YAW_RATE_NOISE_RPS * noise[1]
        return np.column_stack([elapsed_s, speed_mps, yaw_rate_rps])


def state_of(odometry: np.ndarray) -> VehicleState:
    """Return the state that holds for a scan: the one at its first beam."""
    return VehicleState(stamp_ns=0, speed_mps=float(odometry[0, 1]), yaw_rate_rps=float(odometry[0, 2]))


def carried(paths: Paths, pose: Pose2) -> Paths:
    """Return paths traced by a radar at `pose` as seen from the origin: lengths change, weights stay."""
    virtual_m, point_m = paths.virtual_m.copy(), paths.point_m.copy()
    virtual_m[:, :2], point_m[:, :2] = pose.apply(virtual_m[:, :2]), pose.apply(point_m[:, :2])
    farther_m = np.linalg.norm(virtual_m, axis=1) - np.linalg.norm(paths.virtual_m, axis=1)
    return replace(
        paths,
        virtual_m=virtual_m,
        point_m=point_m,
        length_m=paths.length_m + 2.0 * farther_m,
        azimuth_rad=polar_from_xy(virtual_m[:, :2])[1],
    )
