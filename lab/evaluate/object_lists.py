"""Lists of objects or tracks as people have them: our JSON lines and recordings, nuScenes results, KITTI tracking text.

All give the same scans of boxes in the plane, for what is reported and for the truth.
Boxes of nuScenes stay in the axes of their file. Those of KITTI are in the axes of a camera (x right, z ahead), which
become ours (x ahead, y left).
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from models.scores.object_error import as_object
from msgs.files.text_files import read_text
from msgs.recording.mcap import RecordingReader
from msgs.values.perception import BevFrame, HiddenObject, SceneTruth, Track
from nodes.process.validation import convert_at

#: Columns of a row of KITTI tracking, with and without a score.
_KITTI_COLUMNS = (17, 18)
#: Covariance of a box that gives none: it is not scored.
_COVARIANCE_M2 = ((1.0, 0.0), (0.0, 1.0))


class ListedScan(msgspec.Struct, kw_only=True):
    """Objects of one scan; `tracks` are those among them that keep an id over scans."""

    #: Scan id, or the token of a sample.
    key: str
    stamp_ns: int | None = None
    objects: list[HiddenObject] = []
    tracks: list[Track] = []


class ObjectList(msgspec.Struct, frozen=True, kw_only=True):
    """Scans of a file, in its order."""

    path: Path
    scans: list[ListedScan]
    #: Ids last over scans.
    tracked: bool
    #: A scan without objects stands there too.
    lists_empty_scans: bool = True


class _Line(msgspec.Struct, frozen=True, kw_only=True):
    scan_id: int
    stamp_ns: int
    frame: str
    objects: list[HiddenObject] | None = None
    tracks: list[Track] | None = None


class _Box(msgspec.Struct, frozen=True, kw_only=True):
    translation: tuple[float, float, float]
    #: Width, length, height.
    size: tuple[float, float, float]
    #: Quaternion w, x, y, z.
    rotation: tuple[float, float, float, float]
    detection_name: str = ""
    detection_score: float = 1.0
    tracking_id: str | None = None
    tracking_name: str = ""
    tracking_score: float = 1.0


class _Results(msgspec.Struct, frozen=True, kw_only=True):
    results: dict[str, list[_Box]]


def read_list(path: Path) -> ObjectList:
    """Read a list by the end of its name.

    Raises `ValueError` naming the file, the place in it and the rule: an unknown end, columns or fields that are wrong,
    a number that is none, another frame than "radar", an id twice in a scan, a scan twice, no scan at all.
    """
    readers: dict[str, Callable[[Path], ObjectList]] = {
        ".jsonl": _read_lines, ".json": _read_nuscenes, ".txt": _read_kitti, ".mcap": _read_recording
    }  # fmt: skip
    if path.suffix.lower() not in readers:
        raise ValueError(f"{path}: must end in {', '.join(readers)} to be read as a list of objects")
    listed = readers[path.suffix.lower()](path)
    if not listed.scans:
        raise ValueError(f"{path}: holds no scan")
    _require_once((scan.key for scan in listed.scans), f"{path}: scan")
    for scan in listed.scans:
        _require_once((item.id for item in scan.tracks), f"{path}: scan {scan.key}: id")
        _require_once((item.id for item in scan.objects), f"{path}: scan {scan.key}: id")
    return listed


def read_truth(path: Path) -> ObjectList | list[SceneTruth]:
    """Read the truth of a recording as it is, that of any other list as its boxes; errors as of `read_list`."""
    if path.suffix.lower() != ".mcap":
        return read_list(path)
    with RecordingReader(path) as reader:
        truths = [each.message for each in reader.messages(("sim/truth",)) if isinstance(each.message, SceneTruth)]
    if not truths:
        raise ValueError(f"{path}: holds no sim/truth")
    return truths


def _require_once(keys: Iterator[Any], where: str) -> None:
    for key, count in Counter(keys).items():
        if count > 1:
            raise ValueError(f"{where} {key} must be there once, got {count} times")


def _read_lines(path: Path) -> ObjectList:
    scans, tracked = [], False
    for number, text in enumerate(read_text(path).splitlines(), 1):
        line = convert_at(_parsed(text, f"{path}: line {number}"), _Line, f"{path}: line {number}: ")
        if line.frame != "radar":
            raise ValueError(f'{path}: line {number}: frame must be "radar", got {line.frame!r}')
        if (line.objects is None) == (line.tracks is None):
            raise ValueError(f"{path}: line {number}: must hold objects or tracks")
        tracks, tracked = line.tracks or [], tracked or line.tracks is not None
        objects = line.objects if line.tracks is None else [_of_track(track) for track in tracks]
        scans.append(
            ListedScan(key=str(line.scan_id), stamp_ns=line.stamp_ns, objects=objects or [], tracks=tracks)
        )  # fmt: skip
    return ObjectList(path=path, scans=scans, tracked=tracked)


def _of_track(track: Track) -> HiddenObject:
    score = 1.0 if track.existence is None else track.existence
    return msgspec.structs.replace(as_object(track), score=score, object_class=track.object_class)


def _parsed(text: str, where: str) -> Any:
    def refuse(name: str) -> None:
        raise ValueError(f"{where}: numbers must be finite, got {name}")

    try:
        return json.loads(text, parse_constant=refuse)
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{where}: must be JSON: {error}") from None


def _read_recording(path: Path) -> ObjectList:
    with RecordingReader(path) as reader:
        frames = [each.message for each in reader.messages(("perception/hidden_objects",))]
    scans = [
        ListedScan(
            key=str(frame.scan_id), stamp_ns=frame.stamp_ns, objects=list(frame.objects), tracks=list(frame.tracks)
        )
        for frame in frames
        if isinstance(frame, BevFrame)
    ]
    return ObjectList(path=path, scans=scans, tracked=True)


def _read_nuscenes(path: Path) -> ObjectList:
    results = convert_at(_parsed(read_text(path), str(path)), _Results, f"{path}: ").results
    # ids are texts there; each gets the number of its first appearance
    names = [box.tracking_id for boxes in results.values() for box in boxes if box.tracking_id is not None]
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    scans = []
    for token, boxes in results.items():
        scan = ListedScan(key=token, objects=[], tracks=[])
        for index, box in enumerate(boxes):
            w, x, y, z = box.rotation
            is_track = box.tracking_id is not None
            fields = {
                "id": numbers[box.tracking_id] if box.tracking_id is not None else len(numbers) + index,
                "x_m": box.translation[0],
                "y_m": box.translation[1],
                "length_m": box.size[1],
                "width_m": box.size[0],
                "yaw_rad": math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
                "score": box.tracking_score if is_track else box.detection_score,
                "object_class": box.tracking_name if is_track else box.detection_name,
            }
            _add(scan, fields, is_track, f"{path}: results[{token!r}][{index}]: ")
        scans.append(scan)
    return ObjectList(path=path, scans=scans, tracked=bool(numbers))


def _read_kitti(path: Path) -> ObjectList:
    scans: dict[int, ListedScan] = {}
    tracked = False
    for number, text in enumerate(read_text(path).splitlines(), 1):
        where, cells = f"{path}: line {number}", text.split()
        if len(cells) not in _KITTI_COLUMNS:
            raise ValueError(f"{where}: must have 17 columns of KITTI tracking, or 18 with a score, got {len(cells)}")
        frame, track_id = (_number(cells[at], int, f"{where}: {name}") for at, name in ((0, "frame"), (1, "track_id")))
        width_m, length_m, right_m, _, ahead_m, rotation_y_rad, *score = (
            _number(cell, float, f"{where}: column {at}") for at, cell in enumerate(cells[11:], 12)
        )
        scan = scans.setdefault(frame, ListedScan(key=str(frame), objects=[], tracks=[]))
        if cells[2] == "DontCare":
            continue
        fields = {
            "id": track_id if track_id >= 0 else (1 << 30) + number,
            "x_m": ahead_m,
            "y_m": -right_m,
            "length_m": length_m,
            "width_m": width_m,
            "yaw_rad": math.remainder(-rotation_y_rad - 0.5 * math.pi, math.tau),
            "score": score[0] if score else 1.0,
            "object_class": cells[2].lower(),
        }
        tracked = tracked or track_id >= 0
        _add(scan, fields, track_id >= 0, f"{where}: ")
    ordered = [scans[frame] for frame in sorted(scans)]
    return ObjectList(path=path, scans=ordered, tracked=tracked, lists_empty_scans=False)


def _number(text: str, kind: type[int] | type[float], where: str) -> Any:
    try:
        value = kind(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{where} must be a finite {'whole ' if kind is int else ''}number, got {text[:40]!r}")
    return value


def _add(scan: ListedScan, fields: dict[str, Any], is_track: bool, where: str) -> None:
    scan.objects.append(convert_at(fields | {"cov_m2": _COVARIANCE_M2}, HiddenObject, where))
    if is_track:
        at = {name: fields[name] for name in ("id", "x_m", "y_m")}
        scan.tracks.append(
            Track(**at, velocity_x_mps=0.0, velocity_y_mps=0.0, age_s=0.0, cov_m2=_COVARIANCE_M2)
        )  # fmt: skip
