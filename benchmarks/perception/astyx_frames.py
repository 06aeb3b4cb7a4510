"""Reader of Astyx frames (a 77 GHz radar that gives points, with a LiDAR, boxes and a calibration), for checks only."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from models.perception.target_lists.sensor import DetectionSensor
from msgs.values.detections import RadarDetections

FRAMES = ("000005", "000022", "000034", "000036", "000204", "000302")
#: Frame with verified mirror images in a facade.
IMAGE_FRAME = "000036"
#: Weakest magnitude in the files, and its SNR as assumed: no file states one.
FLOOR_DB = 45.0
#: Steps of its radial speeds, 128 of which are the ambiguous interval; ranges come in steps of 0.075 m.
SPEED_STEP_MPS = 0.0812
#: No data sheet was used: resolutions are twice the steps of the files, errors half a resolution; the height is that of
#: the LiDAR's ground.
SENSOR = DetectionSensor(
    name="astyx_6455",
    range_std_m=0.1,
    azimuth_std_deg=0.5,
    elevation_std_deg=1.5,
    speed_std_mps=SPEED_STEP_MPS,
    range_resolution_m=0.3,
    beam_width_deg=1.5,
    azimuth_limit_deg=75.0,
    max_range_m=102.0,
    speed_period_mps=128 * SPEED_STEP_MPS,
    height_m=1.4,
)


@dataclass(frozen=True)
class Box:
    """A labelled object: its class, centre [2], length, width and direction in the radar's axes."""

    name: str
    centre_m: np.ndarray
    length_m: float
    width_m: float
    yaw_rad: float

    def holds(self, points_m: np.ndarray, margin_m: float) -> np.ndarray:
        """Return the points [N, 2] within the box and a margin."""
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        own = (points_m - self.centre_m) @ np.array([[cos, -sin], [sin, cos]])
        return np.asarray((np.abs(own) <= 0.5 * np.array([self.length_m, self.width_m]) + margin_m).all(axis=1))


@dataclass(frozen=True)
class AstyxFrame:
    """One frame: detections, LiDAR points [N, 3] in the radar's axes, boxes."""

    detections: RadarDetections
    lidar_m: np.ndarray
    boxes: tuple[Box, ...]


def read_detections(folder: Path, frame: str, scan_id: int = 0) -> RadarDetections:
    """Return the detections of a frame; its speeds, positive when closing, change their sign."""
    rows = np.loadtxt(folder / "radar_6455" / f"{frame}.txt", skiprows=2)
    range_m = np.linalg.norm(rows[:, :3], axis=1)
    return RadarDetections(
        stamp_ns=scan_id * 100_000_000,
        scan_id=scan_id,
        sensor=SENSOR.name,
        range_m=range_m,
        azimuth_rad=np.arctan2(rows[:, 1], rows[:, 0]),
        covariance=np.zeros((len(rows), 2, 2)),
        elevation_rad=np.arcsin(rows[:, 2] / range_m),
        radial_speed_mps=-rows[:, 3],
        snr_db=rows[:, 4] - FLOOR_DB + SENSOR.threshold_db,
    )


def read_frame(folder: Path, frame: str, scan_id: int = 0) -> AstyxFrame:
    """Return a frame of a folder of the data set."""
    calibration = json.loads((folder / "calibration" / f"{frame}.json").read_text())["sensors"]
    to_radar = np.array(
        next(item["calib_data"]["T_to_ref_COS"] for item in calibration if item["sensor_uid"].startswith("lidar"))
    )
    lidar_m = np.loadtxt(folder / "lidar_vlp16" / f"{frame}.txt", skiprows=1)[:, :3]
    boxes = json.loads((folder / "groundtruth_obj3d" / f"{frame}.json").read_text())["objects"]
    return AstyxFrame(
        read_detections(folder, frame, scan_id), lidar_m @ to_radar[:3, :3].T + to_radar[:3, 3], tuple(map(_box, boxes))
    )


def _box(row: dict) -> Box:  # type: ignore[type-arg]
    w, _, _, z = row["orientation_quat"]
    return Box(
        name=row["classname"],
        centre_m=np.array(row["center3d"][:2]),
        length_m=row["dimension3d"][0],
        width_m=row["dimension3d"][1],
        yaw_rad=2.0 * float(np.arctan2(z, w)),
    )
