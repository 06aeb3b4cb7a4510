"""LiDAR clouds and a radar capture of one scene as a labelled frame: what `mirrorwave annotate` does."""

from __future__ import annotations

import importlib.metadata
import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from contrib.annotate.annotated_capture import frame_points, mean_map, write_frame
from contrib.annotate.clouds import checked_points, read_cloud
from contrib.annotate.manifest import Cloud, Manifest, Pose
from contrib.annotate.registration import PosedCloud, Registration, register
from contrib.annotate.slice_labels import PointLabel, SliceLabels, label_slice
from lab.training.data.xradarnlos import Kind
from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import FormingParams
from msgs.files.checksums import file_sha256, json_lines
from msgs.files.whole_files import write_whole
from msgs.recording.mcap import RecordingReader
from msgs.values.camera import CameraImage
from msgs.values.frames import Pose2
from msgs.values.lidar import LidarPoints
from msgs.values.perception import Peaks
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthMap

#: The camera's image beside the labels, where the capture holds one.
CAMERA = "camera.jpg"
#: How far the ground in the merged cloud may lie from where `radar_height_m` says.
GROUND_TOLERANCE_M = 0.3


@dataclass
class Clouds:
    """Clouds of a scene in the order of the manifest, placed or refused, with what is reported of each."""

    placed: list[PosedCloud] = field(default_factory=list)
    reports: dict[str, dict[str, Any]] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)

    def merged_m(self) -> np.ndarray:
        """All placed points [N, 3] in the radar's frame."""
        return np.concatenate([cloud.points_in_target_m() for cloud in self.placed])


@dataclass(frozen=True, eq=False)
class Annotated:
    """A labelled scene, its map [512, 256], and the report."""

    labels: SliceLabels
    values: np.ndarray
    report: dict[str, Any]
    refused: dict[str, str]


def annotate_scene(
    manifest: Manifest, folder: Path, radar: Path, out: Path, frame: str, kind: Kind, skip_refused: bool,
    advance: Callable[[], None] = lambda: None,
) -> Annotated:  # fmt: skip
    """Register, label and write a scene as `out`/NAME/`frame`, whole or not at all.

    Raises ValueError where a cloud cannot be read or registered (with `skip_refused` only the first), the capture
    holds no complete scan, or the frame exists already.
    """
    target = out / manifest.name
    if any((target / name).exists() for name in (frame, f"{frame}.npy", f"{frame}.npz")):
        raise FileExistsError(17, "exists already; choose another --frame", str(target / frame))
    read = _read_all(manifest, folder, radar, advance)
    try:
        maps = capture_maps(radar, "welch" if kind == "real" else "coherent", advance)
        values = mean_map(maps, kind)
    except ValueError as error:
        raise ValueError(f"{radar}: {error}" if str(radar) not in str(error) else str(error)) from None
    clouds = _place_all(manifest, read, skip_refused, advance)
    merged_m = clouds.merged_m()
    ground_z_m = ground_height_m(merged_m, -manifest.radar_height_m)
    labels = label_slice(merged_m, ground_z_m, manifest.slice, manifest.walls, manifest.seed)
    report: dict[str, Any] = {"name": manifest.name, "frame": frame, "kind": kind, "ground_z_m": ground_z_m}
    report |= _results(labels, kind, clouds) | _provenance(manifest, folder, radar)
    image = nearest_image(radar, maps[0].stamp_ns)
    if image is not None:
        report["camera"] = {"file": CAMERA, "sensor": image.sensor, "stamp_ns": image.stamp_ns}
    _write(target, frame, kind, values, labels, report, image)
    advance()
    return Annotated(labels, values, report, clouds.refused)


def _results(labels: SliceLabels, kind: Kind, clouds: Clouds) -> dict[str, Any]:
    """Return the report's results on points, walls and clouds."""
    points = frame_points(labels, kind)
    counts = {
        "los": len(points.los_m),
        "mirrored": len(points.image_m),
        "wall": len(points.wall_m),
        "hidden": len(labels.hidden_m),
        "hidden_in_no_wall": hidden_in_no_wall(labels),
        "stray": labels.stray,
        "off_map": points.off_map,
    }
    walls = np.round(labels.walls_m, 4).tolist()
    return {"points": counts, "walls": walls, "clouds": list(clouds.reports.values()), "refused": clouds.refused}


def _provenance(manifest: Manifest, folder: Path, radar: Path) -> dict[str, Any]:
    """Return the provenance: hashes of all files, the manifest with all defaults, versions."""
    files = {radar.name: file_sha256(radar)} | {
        cloud.file: file_sha256(folder / cloud.file) for cloud in manifest.clouds
    }
    source = {"radar": radar.name, "sha256": files, "manifest": msgspec.to_builtins(manifest), "versions": _versions()}
    return {"provenance": source}


def stages(manifest: Manifest) -> int:
    """Return how often `advance` is called at least: each cloud read and placed, the radar, the files."""
    return 2 * len(manifest.clouds) + 2


def _read_all(
    manifest: Manifest, folder: Path, radar: Path, advance: Callable[[], None]
) -> dict[str, tuple[Cloud, np.ndarray, int]]:
    """Points of all clouds by their name in the manifest."""
    read = {}
    for index, cloud in enumerate(manifest.clouds):
        if cloud.is_recorded:
            points = recorded_points(folder / cloud.file, cloud.scan)
            if cloud.calibrated and cloud.radar_from_lidar is None:
                pose = mounted_pose(points, radar, manifest.radar_height_m)
                cloud = msgspec.structs.replace(cloud, radar_from_lidar=Pose.of(pose))
            points_m, dropped = checked_points(folder / cloud.file, points.positions_m(), cloud.unit)
            dropped += len(points) - len(points.positions_m())
        else:
            points_m, dropped = read_cloud(folder / cloud.file, cloud.unit)
        read[f"clouds[{index}]"] = (cloud, points_m, dropped)
        advance()
    return read


def recorded_points(path: Path, scan: int) -> LidarPoints:
    """Return cloud `scan` of a recording, from 0; ValueError that names how many it holds."""
    count = 0
    with RecordingReader(path) as reader:
        for count, recorded in enumerate(reader.messages(("lidar/points",)), start=1):
            if count == scan + 1 and isinstance(recorded.message, LidarPoints):
                return recorded.message
    raise ValueError(f"{path}: scan must be one of its {count} messages on lidar/points, counted from 0, got {scan}")


def mounted_pose(points: LidarPoints, radar: Path, radar_height_m: float) -> np.ndarray:
    """Return `radar_from_lidar` [4, 4] of the mountings on the vehicle.

    That of the radar is known of a recording with maps or peaks; else it is the vehicle's origin.
    """
    vehicle_from_radar = Pose2()
    if radar.suffix == ".mcap":
        with RecordingReader(radar) as reader:
            mounted = next(reader.messages(("radar/ra_map", "perception/peaks")), None)
        if mounted is not None and isinstance(mounted.message, RangeAzimuthMap | Peaks):
            vehicle_from_radar = mounted.message.vehicle_from_radar
    at = vehicle_from_radar.inverse() @ points.vehicle_from_lidar
    height_m, yaw_deg = points.lidar_height_m - radar_height_m, math.degrees(at.yaw_rad)
    return Pose(x_m=at.x_m, y_m=at.y_m, z_m=height_m, yaw_deg=yaw_deg).transform()


def nearest_image(radar: Path, stamp_ns: int) -> CameraImage | None:
    """Return the image of a recording that was taken nearest to a time; None where it holds none."""
    if radar.suffix != ".mcap":
        return None
    with RecordingReader(radar) as reader:
        images = (each.message for each in reader.messages(("camera/image",)))
        held = (image for image in images if isinstance(image, CameraImage))
        return min(held, key=lambda image: abs(image.stamp_ns - stamp_ns), default=None)


def _place_all(
    manifest: Manifest, read: dict[str, tuple[Cloud, np.ndarray, int]], skip_refused: bool, advance: Callable[[], None]
) -> Clouds:
    """Calibrated clouds as they are, the others registered to what stands; who fails is tried again after the next."""
    clouds = Clouds()
    for name, (cloud, points_m, dropped) in read.items():
        if cloud.calibrated and cloud.radar_from_lidar is not None:
            pose = cloud.radar_from_lidar.transform()
            _take(clouds, name, cloud, points_m, dropped, pose, None)
            advance()
    waiting = [name for name, (cloud, *_) in read.items() if not cloud.calibrated]
    while waiting:
        done = next((name for name in waiting if _registered(clouds, name, read[name], manifest)), None)
        if done is None:
            break
        waiting.remove(done)
        clouds.refused.pop(done, None)
        advance()
    if waiting and not skip_refused:
        raise ValueError(clouds.refused[waiting[0]])
    clouds.reports = {name: clouds.reports[name] for name in read if name in clouds.reports}
    return clouds


def _registered(clouds: Clouds, name: str, read: tuple[Cloud, np.ndarray, int], manifest: Manifest) -> bool:
    """Place a cloud if its registration holds; else note why not."""
    cloud, points_m, dropped = read
    first = None if cloud.radar_from_lidar is None else cloud.radar_from_lidar.transform()
    try:
        registration = register(points_m, clouds.placed, first, manifest.seed)
        fault = registration.fault(manifest.registration)
    except ValueError as error:
        registration, fault = None, str(error)
    if registration is None or fault is not None:
        hint = "" if first is not None else "; give it a radar_from_lidar to begin from"
        clouds.refused[name] = f"{name}.file {cloud.file}: {fault}{hint}"
        return False
    _take(clouds, name, cloud, points_m, dropped, registration.target_from_source, registration)
    return True


def _take(
    clouds: Clouds, name: str, cloud: Cloud, points_m: np.ndarray, dropped: int, pose: np.ndarray,
    registration: Registration | None,
) -> None:  # fmt: skip
    """Add a cloud at its pose, with its report."""
    clouds.placed.append(PosedCloud(points_m, pose))
    report: dict[str, Any] = {"file": cloud.file, "points": len(points_m), "left_out": dropped}
    report |= {"radar_from_lidar": msgspec.to_builtins(Pose.of(pose)), "start": "calibrated"}
    if registration is not None:
        report |= {
            "start": registration.start,
            "fitness": round(registration.fitness, 6),
            "rmse_m": round(registration.rmse_m, 6),
        }
        report |= {"hold": round(registration.hold.least, 6), "weakest": registration.hold.weakest}
        report |= {"conflict": round(registration.conflict, 6), "pairs": registration.pairs}
    clouds.reports[name] = report


def ground_height_m(cloud_m: np.ndarray, stated_m: float) -> float:
    """Height of the ground in a cloud [N, 3]: the median of what lies near where it is said to be, or that height."""
    near = cloud_m[np.abs(cloud_m[:, 2] - stated_m) <= GROUND_TOLERANCE_M, 2]
    return round(float(np.median(near)), 4) if len(near) >= 50 else stated_m


def hidden_in_no_wall(labels: SliceLabels) -> int:
    """Hidden points that no wall shows the radar."""
    hidden = np.flatnonzero(labels.label == PointLabel.HIDDEN)
    return int(np.count_nonzero(~np.isin(hidden, labels.image_point)))


def capture_maps(radar: Path, mode: str, advance: Callable[[], None] = lambda: None) -> list[RangeAzimuthMap]:
    """The maps of all complete scans of a capture, formed as on the vehicle; ValueError without raw beams."""
    from nodes.player import capture_events

    former: RaFormer | None = None
    maps: list[RangeAzimuthMap] = []
    #: Beams with the set-up's own stamp may stand before it.
    early: list[RadarBeam] = []
    for event in capture_events(radar):
        match event.outgoing.message:
            case RadarSetup() as setup:
                former = started = RaFormer(setup, FormingParams(mode=mode))
                maps += [made for beam in early for made in started.add(beam)]
                early = []
            case RadarBeam() as beam:
                if former is None:
                    early.append(beam)
                else:
                    maps += former.add(beam)
    advance()
    whole = [ra_map for ra_map in maps if not ra_map.missing_beams]
    if not whole:
        raise ValueError(f"{radar}: must hold raw beams of a complete scan, holds none")
    return whole


def _versions() -> dict[str, str]:
    """Of what decides the result."""
    versions = {}
    for name in ("mirrorwave", "open3d-cpu", "open3d", "numpy", "scipy"):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def _write(
    target: Path, frame: str, kind: Kind, values: np.ndarray, labels: SliceLabels, report: dict[str, Any],
    image: CameraImage | None,
) -> None:  # fmt: skip
    """The frame in the published layout, the labelled slice and the report; the frame's folder appears whole."""
    target.mkdir(parents=True, exist_ok=True)
    part = target / f".{frame}.part"
    shutil.rmtree(part, ignore_errors=True)
    try:
        write_frame(part, frame, kind, values, frame_points(labels, kind))
        notes = part / frame
        notes.mkdir(exist_ok=True)
        write_whole(notes / "points.csv", csv_of(labels).encode())
        write_whole(notes / "annotation.json", json_lines(report))
        if image is not None:
            write_whole(notes / CAMERA, image.jpeg.tobytes())
        for made in sorted(part.iterdir()):
            made.rename(target / made.name)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def csv_of(labels: SliceLabels) -> str:
    """All labelled points, a row each and one more for each further image."""
    lines = ["x_m,y_m,label,visible,wall,image_x_m,image_y_m,image_wall"]
    for index, ((x_m, y_m), label) in enumerate(zip(labels.points_m, labels.label, strict=True)):
        wall = labels.wall_of_point[index]
        head = f"{x_m:.4f},{y_m:.4f},{PointLabel(label).name.lower()},{int(labels.visible[index])},"
        head += f"{wall if wall >= 0 else ''},"
        images = np.flatnonzero(labels.image_point == index)
        rows = [f"{labels.image_m[k, 0]:.4f},{labels.image_m[k, 1]:.4f},{labels.image_wall[k]}" for k in images]
        lines += [head + row for row in rows or [",,"]]
    return "\n".join(lines) + "\n"
