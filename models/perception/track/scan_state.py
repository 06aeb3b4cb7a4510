"""State across scans: the vehicle's path, the walls that it is told, the tracked objects."""

from __future__ import annotations

from functools import partial

import msgspec

from models.perception.mirrors.peaks_to_view import WallPrior
from models.perception.see.wall_memory import RadarPose, WallMemory
from models.perception.track.odometry import OdometryPose, ScanOdometry, stationary_pose
from models.perception.track.tracker import Tracker, TrackerParams, TrackParams
from models.perception.track.wall_priors import WallPriorStore
from models.perception.track.yaw_rate_bias import BiasEstimate
from msgs.values.environment import WallPriors
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, Peaks
from msgs.values.vehicle import VehicleState


class MemoryParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the state kept across scans."""

    tracking: bool = True
    tracker: TrackParams = TrackParams()


class ScanMemory:
    """State across scans of one radar: vehicle states in any order, scans in the order of their stamps."""

    def __init__(self, params: MemoryParams) -> None:
        self._odometry = ScanOdometry()
        tracker = TrackerParams(confirm_existence=params.tracker.confirm_existence)
        self._tracker = Tracker(tracker) if params.tracking else None
        self._priors = WallPriorStore()
        self._elements = WallMemory()

    def add(self, state: VehicleState) -> None:
        """Take in a state of the vehicle; see `ScanOdometry` for the states that each scan uses."""
        self._odometry.add(state)

    def add_walls(self, message: WallPriors) -> None:
        """Take in walls from elsewhere; see `WallPriorStore` for the messages that each scan uses."""
        self._priors.add(message)

    def wall_elements_at(self, peaks: Peaks) -> WallMemory:
        """Return what earlier scans showed of walls, at the radar's pose of a scan; nothing where that is not known."""
        pose = self._odometry.at(peaks.stamp_ns)
        if pose is None or pose == stationary_pose():
            self._elements.move(None)
        else:
            self._elements.move(RadarPose(pose.frame, pose.odom_from_vehicle @ peaks.vehicle_from_radar))
        return self._elements

    def pose_at(self, stamp_ns: int) -> OdometryPose | None:
        """Return the vehicle's pose at a scan's stamp; see `ScanOdometry.at`."""
        return self._odometry.at(stamp_ns)

    def pose_before(self, stamp_ns: int) -> OdometryPose | None:
        """Return the vehicle's pose at a time no later than the last scan's."""
        return self._odometry.before(stamp_ns)

    @property
    def yaw_rate_bias(self) -> BiasEstimate:
        """The bias that is subtracted from the yaw rate."""
        return self._odometry.yaw_rate_bias

    def walls_at(self, peaks: Peaks) -> WallPrior | None:
        """Return the wall prior of a scan for `recover_bev`: walls of maps and other sensors; None: there are none."""
        # takes in the states up to the scan: walls move by the motion since their message
        self._odometry.at(peaks.stamp_ns)
        priors = self._priors.at(peaks.stamp_ns, self._odometry.before, peaks.vehicle_from_radar)
        return partial(self._priors.fused, priors) if priors else None

    def tracked(self, view: BevFrame, vehicle_from_radar: Pose2, ego_compensated: bool = True) -> BevFrame:
        """Return the view with its tracks; the radar is stationary while no vehicle state has arrived."""
        if self._tracker is None:
            return view
        tracks = self._tracker.step(view, self._odometry.at(view.stamp_ns), vehicle_from_radar, ego_compensated)
        return msgspec.structs.replace(view, tracks=tracks)
