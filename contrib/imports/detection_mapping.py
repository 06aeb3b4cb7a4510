"""Messages of detections, in bags or live, as columns, and the mappings that say what the columns mean."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from contrib.boards.target_list import AZIMUTH_STD_DEG, CLUSTER_REFUSED, OBJECT_REFUSED, RANGE_STD_M
from contrib.imports.detection_columns import DetectionMapping
from contrib.ros2.point_cloud2 import cloud_columns
from contrib.ros2.ros2_types import CLOUD, RETURN_FIELDS, SCAN
from msgs.files.shipped import LAUNCH, shipped_path
from nodes.process.launch_file import read_yaml_mapping
from nodes.process.validation import convert_at

#: Lists of the published package ars_40X: clusters, and tracked objects, of an ARS 404 or 408.
CLUSTERS, OBJECTS = "ars_40X/msg/ClusterList", "ars_40X/msg/ObjectList"


def mapping_path(kind: str, given: Path | None = None) -> Path:
    """Return the mapping that is given, else the shipped one of a message type."""
    return shipped_path(given) if given else LAUNCH / "detections" / f"{READERS[kind].mapping}.yaml"


def read_mapping(path: Path) -> DetectionMapping:
    """Return a mapping from YAML; `ValueError` names file, field, value and rule."""
    return convert_at(read_yaml_mapping(path), DetectionMapping, f"{path}: ")


def return_columns(message: Any, wanted: Collection[str | int] = ()) -> dict[str | int, np.ndarray]:
    """Return the fields of a `RadarScan`, float64 [returns]; an elevation that is 0 throughout was not measured."""
    columns: dict[str | int, np.ndarray] = {
        name: np.array([getattr(each, name) for each in message.returns], np.float64) for name in RETURN_FIELDS
    }
    if not columns["elevation"].any():
        columns["elevation"] = np.full(len(message.returns), np.nan)
    return columns


def target_columns(message: Any, wanted: Collection[str | int] = ()) -> dict[str | int, np.ndarray]:
    """Return positions, their standard deviations, radial speeds and RCS of an ARS 40X's list, float64 [targets].

    States that are no detections become NaN; without quality frames errors are those of the sensor's data sheet.
    """
    is_clusters = hasattr(message, "clusters")
    targets = message.clusters if is_clusters else message.objects
    refused = CLUSTER_REFUSED if is_clusters else OBJECT_REFUSED
    rows = np.array([_target_row(each) for each in targets], np.float64).reshape(len(targets), 6)
    x_m, y_m, x_var_m2, y_var_m2, vx_mps, vy_mps = rows.T
    state = [each.invalid_state if is_clusters else each.meas_state for each in targets]
    range_m = np.hypot(x_m, y_m)
    with np.errstate(all="ignore"):
        return {
            "x": np.where([each in refused for each in state], np.nan, x_m) if targets else x_m,
            "y": y_m,
            "x_std": np.where(x_var_m2 > 0.0, np.sqrt(x_var_m2), RANGE_STD_M),
            "y_std": np.where(
                y_var_m2 > 0.0, np.sqrt(y_var_m2), np.hypot(RANGE_STD_M, np.radians(AZIMUTH_STD_DEG) * range_m)
            ),
            "v_r": (x_m * vx_mps + y_m * vy_mps) / range_m,
            # one version of the package has it, the others have not
            "rcs": np.array([getattr(each, "rcs", np.nan) for each in targets], np.float64),
        }


def _target_row(target: Any) -> tuple[float, ...]:
    place, speed = target.position, target.relative_velocity
    return (
        place.pose.position.x, place.pose.position.y, place.covariance[0], place.covariance[7],
        speed.twist.linear.x, speed.twist.linear.y,
    )  # fmt: skip


class MessageFormat(NamedTuple):
    """A type of messages: the shipped mapping, and what reads columns and complains of those alone that are wanted."""

    mapping: str
    columns: Callable[[Any, Collection[str | int]], dict[str | int, np.ndarray]]


READERS = {
    CLOUD: MessageFormat("point_cloud2", cloud_columns),
    SCAN: MessageFormat("radar_scan", return_columns),
    CLUSTERS: MessageFormat("ars_40x", target_columns),
    OBJECTS: MessageFormat("ars_40x", target_columns),
}
