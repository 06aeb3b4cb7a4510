"""Player of a scene as a single-photon LiDAR: photon histograms scan by scan, truth, and the vehicle's own motion."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from msgs.values.lidar import LidarSetup, PhotonHistograms
from msgs.values.perception import SceneTruth
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.vehicle import VehicleState
from sim_player.lidar.spad import BUDGET, OpticalPaths, optical_paths, spad_histograms
from sim_player.paths.ray_tracing import trace
from sim_player.paths.truth import scene_truth
from sim_player.scene.clear_path import ego_meeting, require_unmet
from sim_player.scene.description import Scene
from sim_player.scene.world import prepare

#: Azimuths for which a scene that moves is frozen together, at the start of the first: 0.24 s with Table 2.
BLOCK = 8


class LidarPlayer:
    """Histograms and truth of a scene at any scan, in any order: same seed, same bytes; ValueError for no LiDAR.

    Nothing moves between the `BLOCK` azimuths of a block; a scene at rest is traced once.
    """

    def __init__(self, scene: Scene, seed: int = 0, start_ns: int = 0) -> None:
        if scene.radar.preset != "spad":
            raise ValueError(f"radar.preset: must be 'spad' for a LiDAR, got {scene.radar.preset!r}")
        self.scene = scene
        self.setup: LidarSetup = msgspec.structs.replace(scene.lidar, stamp_ns=start_ns)
        self._seed = seed
        self._world = prepare(scene, seed)
        # of a scene that is good
        self._meeting = ego_meeting(scene)
        self._still = None if scene.moves else optical_paths(self._world, self.setup)

    def stamp_ns(self, scan: int, azimuth: int = 0) -> int:
        """Return when the measurement of an azimuth starts."""
        return int(self._start_ns(scan) + ns_from_s(azimuth * self.setup.spad.measurement_time_s))

    def paths(self, scan: int) -> OpticalPaths:
        """Return all paths of light of a scan."""
        if self._still is not None:
            return self._still
        starts = range(0, self.setup.grid.azimuth_bins, BLOCK)
        every = np.arange(self.setup.grid.azimuth_bins)
        times_s = [self._elapsed_s(self.stamp_ns(scan, start)) for start in starts]
        blocks = np.split(every, starts[1:])
        traced = zip(times_s, blocks, strict=True)
        return OpticalPaths.joined([optical_paths(self._world, self.setup, at, BUDGET, block) for at, block in traced])

    def scan(self, scan: int) -> PhotonHistograms:
        """Return one scan's histograms, as measured; ValueError for a negative number."""
        if scan < 0:
            raise ValueError(f"scan must not be negative, got {scan!r}")
        stamps = [self.stamp_ns(scan, azimuth) for azimuth in range(self.setup.grid.azimuth_bins)]
        return PhotonHistograms(
            stamp_ns=stamps[0],
            scan_id=scan,
            counts=spad_histograms(self.setup, self.paths(scan), [self._seed, scan]),
            azimuth_stamp_ns=np.array(stamps, np.int64),
        )

    def truth(self, scan: int) -> SceneTruth:
        """Return the truth at the start of a scan, for the X-band radar at the same position."""
        stamp_ns = self.stamp_ns(scan)
        time_s = self._elapsed_s(stamp_ns)
        return scene_truth(self._world, self.scene.setup, trace(self._world, time_s), time_s, stamp_ns, scan)

    def vehicle_state(self, stamp_ns: int) -> VehicleState:
        """Return the vehicle's constant motion, as its bus would report it."""
        ego = self.scene.ego
        return VehicleState(stamp_ns=stamp_ns, speed_mps=ego.speed_mps, yaw_rate_rps=math.radians(ego.yaw_rate_dps))

    def _start_ns(self, scan: int) -> int:
        return self.setup.stamp_ns + scan * ns_from_s(self.setup.period_s)

    def _elapsed_s(self, stamp_ns: int) -> float:
        """Return the time since the start; ValueError once the sensor has met a wall."""
        time_s = s_from_ns(stamp_ns - self.setup.stamp_ns)
        require_unmet(self.scene, self._meeting, time_s)
        return time_s
