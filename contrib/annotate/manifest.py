"""Manifest of `mirrorwave annotate`: a scene's clouds, first poses, heights and rules, in YAML or JSON."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from contrib.annotate.registration import RegistrationParams
from contrib.annotate.slice_labels import SliceParams, WallRules
from nodes.process.launch_file import read_yaml_mapping
from nodes.process.validation import convert_at


class Pose(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Pose of a LiDAR in the radar's frame: roll, then pitch, then yaw about x, y, z, then the position."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0

    def transform(self) -> np.ndarray:
        """`radar_from_lidar` [4, 4]."""
        from scipy.spatial.transform import Rotation

        out = np.eye(4)
        angles_deg = [self.roll_deg, self.pitch_deg, self.yaw_deg]
        out[:3, :3] = Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix()
        out[:3, 3] = self.x_m, self.y_m, self.z_m
        return out

    @classmethod
    def of(cls, transform: np.ndarray) -> Pose:
        """The pose of a rigid transform [4, 4]."""
        from scipy.spatial.transform import Rotation

        roll, pitch, yaw = Rotation.from_matrix(transform[:3, :3]).as_euler("xyz", degrees=True).round(6).tolist()
        x_m, y_m, z_m = transform[:3, 3].round(6).tolist()
        return cls(x_m=x_m, y_m=y_m, z_m=z_m, roll_deg=roll, pitch_deg=pitch, yaw_deg=yaw)


class Cloud(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """One LiDAR cloud: its file, relative to the manifest's, and where it was taken.

    `calibrated`: the pose stands as it is; else it is a first guess, or None to be searched for. A recording (.mcap)
    gives the cloud `scan` of its `lidar/points`, calibrated by its mounting where no pose is given.
    """

    file: str
    scan: Annotated[int, Meta(ge=0)] = 0
    unit: Literal["m", "mm"] = "m"
    radar_from_lidar: Pose | None = None
    calibrated: bool = False

    @property
    def is_recorded(self) -> bool:
        """Whether the cloud is a message of a recording."""
        return Path(self.file).suffix.lower() == ".mcap"


class Manifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scene to annotate."""

    formerly: ClassVar[dict[str, str]] = {
        "slice": "contrib.annotate.slice_labels",
        "walls": "contrib.annotate.slice_labels",
        "registration": "contrib.annotate.registration",
    }

    name: str
    #: Of the antenna over the ground.
    radar_height_m: float
    clouds: tuple[Cloud, ...]
    #: Capture of the radar, relative to the manifest's folder; `--radar` overrules.
    radar: str | None = None
    slice: SliceParams = SliceParams()
    walls: WallRules = WallRules()
    registration: RegistrationParams = RegistrationParams()
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.name or set(self.name) & set('/\\:*?"<>|') or self.name.startswith("."):
            raise ValueError(f"name must be usable as a folder's name, got {self.name!r}")
        if not 0.0 < self.radar_height_m < 100.0:
            raise ValueError(f"radar_height_m must be in 0..100, got {self.radar_height_m!r}")
        if not self.clouds:
            raise ValueError("clouds must hold at least one cloud, holds none")
        fixed = [cloud for cloud in self.clouds if cloud.calibrated]
        if any(cloud.scan and not cloud.is_recorded for cloud in self.clouds):
            raise ValueError("clouds: scan is for recordings (.mcap)")
        if not fixed or any(cloud.radar_from_lidar is None and not cloud.is_recorded for cloud in fixed):
            raise ValueError(
                "clouds: one must have calibrated: true and its radar_from_lidar, to tie the others to the radar"
            )


def load_manifest(path: Path) -> Manifest:
    """Read and check a manifest; ValueError in one line that names file, field, value and rule."""
    manifest = convert_at(read_yaml_mapping(path), Manifest, f"{path}: ")
    try:
        _require_finite(msgspec.to_builtins(manifest), "")
        return manifest
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _require_finite(value: Any, field: str) -> None:
    """ValueError, field first, where any number below a plain value is not finite."""
    if isinstance(value, dict):
        for key, inner in value.items():
            _require_finite(inner, f"{field}.{key}" if field else str(key))
    elif isinstance(value, list | tuple):
        for index, inner in enumerate(value):
            _require_finite(inner, f"{field}[{index}]")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{field}: must be finite, got {value!r}")
