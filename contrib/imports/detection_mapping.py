"""Messages of detections, in bags or live, as columns, and the mappings that say what the columns mean."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np

from contrib.imports.detection_columns import DetectionMapping
from contrib.ros2.point_cloud2 import cloud_columns
from contrib.ros2.ros2_types import CLOUD, RETURN_FIELDS, SCAN
from msgs.files.shipped import LAUNCH, shipped_path
from nodes.process.launch_file import read_yaml_mapping
from nodes.process.validation import convert_at


def mapping_path(kind: str, given: Path | None = None) -> Path:
    """Return the mapping that is given, else the shipped one of a message type."""
    name = "point_cloud2" if kind == CLOUD else "radar_scan"
    return shipped_path(given) if given else LAUNCH / "detections" / f"{name}.yaml"


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


#: What reads the columns of each message type, and complains of those alone that are wanted.
READERS: dict[str, Callable[[Any, Collection[str | int]], dict[str | int, np.ndarray]]] = {
    CLOUD: cloud_columns,
    SCAN: return_columns,
}
