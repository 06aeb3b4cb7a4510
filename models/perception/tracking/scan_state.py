"""State across scans: the vehicle's path, the walls it passed, the tracked objects."""

from __future__ import annotations

from functools import partial

import msgspec

from models.perception.geometry.stage import WallPrior
from models.perception.tracking.odometry import OdometryParams, ScanOdometry, stationary_pose
from models.perception.tracking.tracker import Tracker, TrackerParams
from models.perception.tracking.wall_map import WallMap, WallMapParams
from models.perception.tracking.yaw_rate_bias import BiasEstimate
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, Peaks
from msgs.values.vehicle import VehicleState


class MemoryParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the state kept across scans."""

    tracking: bool = True
    #: Walls of earlier scans serve as mirrors too, where vehicle states give the motion of the radar between scans.
    wall_map: bool = False
    odometry: OdometryParams = OdometryParams()
    tracker: TrackerParams = TrackerParams()
    walls: WallMapParams = WallMapParams()


class ScanMemory:
    """State across scans of one radar: vehicle states in any order, scans in the order of their stamps."""

    def __init__(self, params: MemoryParams) -> None:
        self._odometry = ScanOdometry(params.odometry)
        self._tracker = Tracker(params.tracker) if params.tracking else None
        self._walls = WallMap(params.walls) if params.wall_map else None

    def add(self, state: VehicleState) -> None:
        """Take in a state of the vehicle; see `ScanOdometry` for the states that each scan uses."""
        self._odometry.add(state)

    @property
    def yaw_rate_bias(self) -> BiasEstimate:
        """The bias that is subtracted from the yaw rate."""
        return self._odometry.yaw_rate_bias

    def walls_at(self, peaks: Peaks) -> WallPrior | None:
        """Return the wall prior for `recover_bev`; None where no walls are kept or no state has arrived."""
        pose = self._odometry.at(peaks.stamp_ns)
        # a radar that only seems to stand would find every wall at several positions
        if self._walls is None or pose is None or pose == stationary_pose():
            return None
        return partial(self._walls.step, peaks.stamp_ns, pose, peaks.vehicle_from_radar)

    def tracked(self, view: BevFrame, vehicle_from_radar: Pose2) -> BevFrame:
        """Return the view with its tracks; the radar is stationary as long as no vehicle state has arrived (`view.ego`
        is None).
        """
        if self._tracker is None:
            return view
        tracks = self._tracker.step(view, self._odometry.at(view.stamp_ns), vehicle_from_radar)
        return msgspec.structs.replace(view, tracks=tracks)
