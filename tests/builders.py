"""Values that tests of several rooms build alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from models.perception.chain import Chain
from models.perception.find.detectors import CfarDetector
from models.perception.find.maps_to_peaks import DetectionStage
from models.perception.form.beams_to_maps import FormingStage
from models.perception.form.ra_forming import FormingParams
from models.perception.track.scan_state import MemoryParams
from models.perception.track.views_over_scans import ViewStage
from models.physics.mirror import wall_from_ends
from msgs.values.diagnostics import NodeState, NodeStatus
from msgs.values.frames import polar_from_xy
from msgs.values.perception import BevFrame, BevGrid, HiddenObject, PathClass, Peaks, SceneTruth, Track, Wall
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthMap


def cfar_chain(setup: RadarSetup, forming: FormingParams | None = None, memory: MemoryParams | None = None) -> Chain:
    """A chain that looks with CFAR, of the defaults unless told otherwise."""
    detector = CfarDetector(setup)
    chain = Chain(FormingStage(forming), DetectionStage(lambda _: detector), ViewStage(memory=memory))
    chain.set_up(setup)
    return chain


def example_map(values: np.ndarray, **fields: Any) -> RangeAzimuthMap:
    """A coherent map of these values, of scan 0 at time 0 with a noise of 1 mW, unless told otherwise."""
    bins, azimuths = values.shape
    plain: dict[str, Any] = {"stamp_ns": 0, "scan_id": 0, "noise_power_mw": 1.0, "incoherent": np.zeros(bins, bool)}
    plain["azimuth_stamp_ns"] = np.zeros(azimuths, np.int64)
    return RangeAzimuthMap(values=values.astype(np.complex64), **plain | fields)


def example_beam(**fields: Any) -> RadarBeam:
    """The first of 25 beams, straight ahead, of one sample of silence, unless told otherwise."""
    plain: dict[str, Any] = {"stamp_ns": 0, "scan_id": 0, "beam_index": 0, "beam_count": 25, "azimuth_rad": 0.0}
    return RadarBeam(**{"samples": np.zeros((1, 1, 2), np.int16), "full_scale_dbm": 0.0} | plain | fields)


def peaks_at(direct_m: Any, images_m: Any = (), stds: tuple[float, float] = (0.1, 0.01), **fields: Any) -> Peaks:
    """Peaks of direct returns and of images at points, score 0.9 and 30 dB each, unless told otherwise.

    `stds`: of range [m] and azimuth [rad].
    """
    classes = [np.asarray(points_m, np.float64).reshape(-1, 2) for points_m in (direct_m, images_m)]
    range_m, azimuth_rad = polar_from_xy(np.concatenate(classes))
    count = len(range_m)
    plain: dict[str, Any] = {"stamp_ns": 0, "scan_id": 0, "score": np.full(count, 0.9), "snr_db": np.full(count, 30.0)}
    plain["path_class"] = np.repeat(np.array([PathClass.LOS, PathClass.MIRRORED], np.uint8), [len(c) for c in classes])
    plain["covariance"] = np.tile(np.diag(np.square(stds)), (count, 1, 1))
    plain["peak_stamp_ns"] = np.full(count, fields.get("stamp_ns", 0), np.int64)
    return Peaks(range_m=range_m, azimuth_rad=azimuth_rad, **plain | fields)


def wall_between(a: Sequence[float], b: Sequence[float], **fields: Any) -> Wall:
    """A wall of nine returns between two ends, its normal towards the radar, unless told otherwise."""
    normal, offset_m = wall_from_ends(np.array(a), np.array(b), np.zeros(2))
    plain: dict[str, Any] = {"inliers": 9, "angle_std_rad": 0.01, "offset_std_m": 0.05}
    return Wall(normal=tuple(normal.tolist()), offset_m=offset_m, ends_m=(tuple(a), tuple(b)), **plain | fields)


def example_view(rows: int = 2, columns: int = 2, **fields: Any) -> BevFrame:
    """A view of scan 0 at time 0 with nothing in it and nothing observed, unless told otherwise."""
    plain: dict[str, Any] = {"stamp_ns": 0, "scan_id": 0, "grid": BevGrid(rows=rows, columns=columns)}
    plain |= {"visibility": np.zeros((rows, columns), np.uint8), "los_points_m": np.zeros((0, 2), np.float32)}
    return BevFrame(**plain | fields)


def example_truth(**fields: Any) -> SceneTruth:
    """The truth of scan 0 at time 0 without a point, unless told otherwise."""
    none = np.zeros((0, 3), np.float32)
    plain: dict[str, Any] = {"stamp_ns": 0, "scan_id": 0, "hidden_object": np.zeros(0, np.int32)}
    plain |= dict.fromkeys(("los_points_m", "mirrored_points_m", "hidden_points_m"), none)
    return SceneTruth(**plain | fields)


def beam_of(setup: RadarSetup, index: int, samples: np.ndarray, **fields: Any) -> RadarBeam:
    """A beam of a set-up at its time in scan 0, unless told otherwise."""
    plain: dict[str, Any] = {"stamp_ns": index * setup.beam_interval_ns, "beam_count": len(setup.beams)}
    plain["azimuth_rad"] = float(setup.beams.azimuth_rad[index])
    plain["full_scale_dbm"] = setup.full_scale_dbm
    return example_beam(beam_index=index, samples=samples, **plain | fields)


def example_object(**fields: Any) -> HiddenObject:
    """A car-sized object 0 at the radar, of score 0.9 and a metre of error, unless told otherwise."""
    plain: dict[str, Any] = {"id": 0, "x_m": 0.0, "y_m": 0.0, "length_m": 4.0, "width_m": 2.0, "yaw_rad": 0.0}
    return HiddenObject(**plain | {"score": 0.9, "cov_m2": ((1.0, 0.0), (0.0, 1.0))} | fields)


def example_track(**fields: Any) -> Track:
    """A track at (1, 2) m, followed for a second, known to a metre, unless told otherwise."""
    plain: dict[str, Any] = {"id": 1, "x_m": 1.0, "y_m": 2.0, "velocity_x_mps": 0.0, "velocity_y_mps": 0.0}
    return Track(**plain | {"age_s": 1.0, "cov_m2": ((1.0, 0.0), (0.0, 1.0))} | fields)


def example_status(**fields: Any) -> NodeStatus:
    """The heartbeat of a node that is well, of process 1 at time 0, unless told otherwise."""
    return NodeStatus(**{"stamp_ns": 0, "node": "geometry", "pid": 1, "state": NodeState.READY} | fields)
