"""Frames of a data set: maps with their truth, and fixed splits by scene.

A folder holds shards (`shard-*.npz`) of beam profiles, from which maps are formed as on the vehicle, or of maps made
elsewhere (`series.json` then says `"format": "maps"` and the grid).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from models.perception.form.coarray import AzimuthInterpolator
from models.perception.form.ra_forming import ScanProfiles, beam_middle_s, form_map, look_azimuths
from models.perception.form.radial_speed import unit_std_mps
from msgs.files.array_files import array_names, load_arrays
from msgs.files.whole_files import write_whole
from msgs.values.array_table import ArrayTable
from msgs.values.environment import PriorWall
from msgs.values.frames import Pose2
from msgs.values.perception import PathClass, TruthObject
from msgs.values.radar import PRESETS, RadarSetup, RangeAzimuthGrid, RangeAzimuthMap, mps_from_speed_codes
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState
from sim_player.dataset.shards import FORMAT

#: Arrays of every shard beside its profiles or values: noise [scenes], and the truth points of all scenes in one
#: row, those of scene i at offset[i]..offset[i + 1].
SHARD_ARRAYS = ("noise_power_mw", "offset", "range_m", "azimuth_rad", "path_class")
#: Shares of training, validation and test: 1512, 324 and 324 of the published 2160.
SHARES = (0.70, 0.15, 0.15)


@dataclass(frozen=True, kw_only=True)
class FrameLabels(ArrayTable):
    """Truth points of one map, strongest first; arrays [points], positions [points, 2]."""

    range_m: np.ndarray
    azimuth_rad: np.ndarray
    #: `PathClass` values.
    path_class: np.ndarray
    #: Number of mirrors on the path; -1 if the data set does not say.
    order: np.ndarray
    #: True position in the radar's frame; NaN if unknown.
    hidden_xy_m: np.ndarray
    #: Power in the beam that sees the point best; NaN if unknown.
    power_mw: np.ndarray
    #: Index into the scene's objects, -1 for a wall or if unknown; and its class, "" if unknown.
    object_index: np.ndarray
    object_class: np.ndarray


@dataclass(frozen=True, kw_only=True)
class _LabelledScene:
    """Truth and facts of one scene."""

    index: int
    #: Of a beam for profiles, of a cell for values; per bin.
    noise_power_mw: float = 0.0
    labels: FrameLabels
    place: str = ""
    #: Kinds of the walls that mirror, as `curved_wall`.
    relays: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    #: Indices of the objects that only mirrors show.
    hidden: tuple[int, ...] = ()
    scene_yaml: str = ""
    #: Captures of one drive share it: a split never divides a sequence.
    sequence: str = ""
    #: All objects in the radar's frame; None: the data set does not say.
    truth: tuple[TruthObject, ...] | None = None
    #: True positions [M, 2] of all images together if they do not pair with them; None: those of the labels.
    places_m: np.ndarray | None = None
    #: Pose of the radar in its frame at the start of the drive; None: the data set does not say.
    pose: Pose2 | None = None
    #: Walls in the radar's frame, exact and as a poor map has them; empty: the data set does not say.
    walls: tuple[PriorWall, ...] = ()
    map_walls: tuple[PriorWall, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Scan(_LabelledScene):
    """One scene of a shard as stored: beam profiles complex64 [beams, bins] or map values [range, azimuth]."""

    profiles: np.ndarray | None
    values: np.ndarray | None
    missing_beams: tuple[int, ...]
    #: State of the vehicle by which its motion was taken out of the profiles; None: it was not.
    ego: VehicleState | None = None
    #: Radial speed of each bin of the profiles, [beams, bins], NaN in noise; None: not measured.
    radial_speed_mps: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class Frame(_LabelledScene):
    """A formed map with its truth and the facts of its scene."""

    ra_map: RangeAzimuthMap


#: A finite number of an array.
SceneIndex = Annotated[int, msgspec.Meta(ge=-(1 << 62), le=1 << 62)]


class Splits(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Scene indices of training, validation and test, sorted, and the identity of the test scenes."""

    seed: int
    train: list[SceneIndex]
    validation: list[SceneIndex]
    test: list[SceneIndex]
    #: Over profiles and truth of the test scenes, in order.
    test_sha256: str

    def of(self, name: str) -> np.ndarray:
        """Return the scenes of one split, or of `all`."""
        if name == "all":
            return np.sort(np.concatenate([self.train, self.validation, self.test])).astype(np.int64)
        if name not in ("train", "validation", "test"):
            raise ValueError(f"split must be train, validation, test or all, got {name!r}")
        return np.array(getattr(self, name), np.int64)


class DataSet:
    """The scenes of a folder; raises `ValueError` naming the file if there are none or one is not a shard."""

    def __init__(self, directory: Path) -> None:
        self.directory = Path(directory)
        paths = sorted(self.directory.glob("shard-*.npz"))
        if not paths:
            raise ValueError(f"{self.directory} must hold shards (shard-*.npz), found none")
        self.series = _series(self.directory / "series.json")
        counts = [_scene_count(path) for path in paths]
        self._location = [(path, scene) for path, count in zip(paths, counts, strict=True) for scene in range(count)]

    def __len__(self) -> int:
        return len(self._location)

    @cached_property
    def grid(self) -> RangeAzimuthGrid:
        """The grid of the maps."""
        try:
            return msgspec.convert(self.series.get("grid", {}), RangeAzimuthGrid)
        except msgspec.ValidationError as error:
            raise ValueError(f"{self.directory / 'series.json'}: grid: {error}") from None

    @property
    def setup(self) -> RadarSetup:
        """The radar that recorded the scenes; up to format 4 phases were rounded from the first column on."""
        setup, written = PRESETS[self.series.get("preset", "xband")], self.series.get("format")
        if isinstance(written, int) and written <= 4:
            array = msgspec.structs.replace(setup.array, phases_from_centre=False)
            return msgspec.structs.replace(setup, array=array)
        return setup

    @cached_property
    def _interpolator(self) -> AzimuthInterpolator:
        return AzimuthInterpolator(self.setup, self.grid)

    def scan(self, index: int) -> Scan:
        """Return one scene as stored; raises `ValueError` if it holds a non-finite value."""
        path, scene = self._location[index]
        return _scan(path, _arrays(path, path.stat().st_mtime_ns), scene, index)

    def frame(self, index: int, transform: Callable[[Scan], Scan] = lambda scan: scan) -> Frame:
        """Return one scene as a map with its truth; `transform` may replace its radar by another."""
        scan = transform(self.scan(index))
        known = {field.name: getattr(scan, field.name) for field in fields(_LabelledScene)}
        return Frame(ra_map=scan_map(scan, self._interpolator), **known)

    def frames(self, indices: Iterable[int], transform: Callable[[Scan], Scan] = lambda scan: scan) -> Iterator[Frame]:
        """Yield scenes one after the other, as `frame` makes them."""
        return (self.frame(int(index), transform) for index in indices)

    def fingerprint(self, index: int) -> str:
        """Return a hash of the echoes and the truth of a scene; equal only for equal scenes."""
        scan = self.scan(index)
        measured = scan.values if scan.profiles is None else scan.profiles
        digest = hashlib.sha256(np.ascontiguousarray(measured).tobytes())
        for array in (scan.labels.range_m, scan.labels.azimuth_rad, scan.labels.path_class, scan.labels.hidden_xy_m):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def identity(self, index: int) -> dict[str, str]:
        """Return the properties by which one scene reveals another, by kind: the same echoes, drive or place.

        A place simulated again, with other effects or another version, has other echoes and the same description;
        captures of one drive are consecutive.
        """
        scan = self.scan(index)
        properties = {"echoes": self.fingerprint(index), "drive": scan.sequence, "place": scan.scene_yaml}
        return {kind: value for kind, value in properties.items() if value}


def shard_scans(path: Path) -> list[Scan]:
    """Return the scenes of one shard, numbered from 0: for a folder that still grows."""
    arrays = _arrays(path, path.stat().st_mtime_ns)
    return [_scan(path, arrays, scene, scene) for scene in range(len(arrays["noise_power_mw"]))]


#: Kinds of numbers (`numpy.dtype.kind`) and axes of a shard's arrays; other arrays are ignored.
ARRAYS = {
    **dict.fromkeys(("profiles", "values"), ("cfiu", 3)),
    **dict.fromkeys(("noise_power_mw", "range_m", "azimuth_rad", "power_mw"), ("fiu", 1)),
    **dict.fromkeys(("hidden_xy_m", "places_m"), ("fiu", 2)),
    **dict.fromkeys(("offset", "place_offset", "path_class", "order", "object_index"), ("iu", 1)),
    **dict.fromkeys(("scene_yaml", "sequence", "object_class", "facts"), ("SU", 1)),
    "missing_beams": ("b", 2),
    "odometry": ("f", 3),
    "pose": ("f", 2),
    "radial_speed_cmps": ("i", 3),
}


class _Facts(msgspec.Struct):
    """Facts of a scene in a shard, as far as they are used."""

    place: str = ""
    relays: tuple[str, ...] = ()
    objects: tuple[Any, ...] = ()
    hidden: tuple[Any, ...] = ()
    truth: tuple[TruthObject, ...] | None = None
    walls: tuple[PriorWall, ...] = ()
    map_walls: tuple[PriorWall, ...] = ()


def scan_map(scan: Scan, interpolator: AzimuthInterpolator) -> RangeAzimuthMap:
    """Return the map of a scan, formed from its profiles as on the vehicle or taken unchanged."""
    grid = interpolator.grid
    if scan.profiles is not None:
        return form_map(
            ScanProfiles(
                stamp_ns=0,
                scan_id=scan.index,
                profiles=scan.profiles,
                noise_power_mw=scan.noise_power_mw,
                beam_stamp_ns=_beam_stamps(scan, interpolator.setup),
                missing_beams=scan.missing_beams,
                look_azimuth_rad=None if scan.ego is None else look_azimuths(interpolator.setup, grid, scan.ego),
                radial_speed_mps=scan.radial_speed_mps,
                radial_speed_unit_std_mps=speed_unit_std_mps(interpolator.setup),
            ),
            interpolator,
        )
    if scan.values is None:
        raise ValueError(f"scene {scan.index} must hold profiles or values, got neither")
    return RangeAzimuthMap(
        stamp_ns=0,
        scan_id=scan.index,
        grid=grid,
        values=scan.values,
        azimuth_stamp_ns=np.zeros(grid.azimuth_bins, np.int64),
        noise_power_mw=scan.noise_power_mw,
        # power alone does not show it; a complex map made elsewhere counts as coherent
        incoherent=np.full(grid.range_bins, not np.any(scan.values.imag), np.bool_),
    )


def speed_unit_std_mps(setup: RadarSetup) -> float:
    """Return the standard deviation of a beam's radial speed at an SNR of 1."""
    return unit_std_mps(setup.radar.wavelength_m, setup.radar.chirps_per_beam * setup.radar.repetition_interval_s)


def _beam_stamps(scan: Scan, setup: RadarSetup) -> np.ndarray:
    """Return the times of the beams of a drive's scan, int64 [beams]; zero where nothing moves."""
    if scan.ego is None or scan.profiles is None:
        return np.zeros(len(setup.beams), np.int64)
    return np.array([ns_from_s(beam_middle_s(setup, beam)) for beam in range(len(scan.profiles))], np.int64)


def _series(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    try:
        series = msgspec.json.decode(path.read_bytes(), type=dict)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None
    if series.get("preset", "xband") not in tuple(PRESETS):
        raise ValueError(f"{path}: preset must be one of {', '.join(PRESETS)}, got {series['preset']!r}")
    written = series.get("format", FORMAT)
    if written != "maps" and written not in range(1, FORMAT + 1):
        raise ValueError(f"{path}: this version reads formats 1..{FORMAT} and 'maps', got {written!r}")
    return series


def _scene_count(path: Path) -> int:
    names, scenes = _open(path)
    missing = [name for name in SHARD_ARRAYS if name not in names]
    if not {"profiles", "values"} & set(names):
        missing.append("profiles (or values)")
    if missing:
        raise ValueError(
            f"{path} must hold the arrays {', '.join(SHARD_ARRAYS)} and profiles or values; "
            f"it lacks {', '.join(missing)}"
        )
    return scenes


def _open(path: Path) -> tuple[list[str], int]:
    """Return the names of the arrays of a shard, and its number of scenes; 0 if it does not say."""
    try:
        scenes = sum(np.atleast_1d(noise).size for noise in load_arrays(path, ("noise_power_mw",)).values())
        return array_names(path), scenes
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} must be a shard (npz): {' '.join(str(error).split())}") from None


@lru_cache(maxsize=2)
def _arrays(path: Path, changed_ns: int) -> dict[str, np.ndarray]:
    """Return all arrays of a shard as of its last change; neighbouring scenes come from the same one."""
    arrays = load_arrays(path)
    arrays.pop("plan", None)
    _check_arrays(path, arrays)
    return arrays


def _check_arrays(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raise `ValueError` naming the shard and the array that does not fit the others or is not valid truth."""
    _check_kinds(path, arrays)
    offset, scenes = arrays["offset"], len(arrays["noise_power_mw"])
    points = len(arrays["range_m"])
    _check_offset(path, "offset", offset, scenes, points)
    if "places_m" in arrays:
        _check_offset(path, "place_offset", arrays.get("place_offset", np.zeros(0)), scenes, len(arrays["places_m"]))
    per_scene = (
        "profiles", "values", "facts", "scene_yaml", "sequence", "missing_beams", "odometry", "pose",
        "radial_speed_cmps",
    )  # fmt: skip
    lengths = dict.fromkeys(per_scene, scenes)
    lengths |= {field.name: points for field in fields(FrameLabels)}
    for name, length in lengths.items():
        if name in arrays and len(arrays[name]) != length:
            raise ValueError(f"{path}: {name} must have length {length}, got {len(arrays[name])}")
    for name in ("noise_power_mw", "range_m", "azimuth_rad"):
        if not np.isfinite(arrays[name]).all():
            raise ValueError(
                f"{path}: {name} must be finite, index {np.flatnonzero(~np.isfinite(arrays[name]))[0]} is not"
            )
    if not np.isin(arrays["path_class"], list(PathClass)).all():
        raise ValueError(f"{path}: path_class must be 0 (LOS) or 1 (mirrored), got {arrays['path_class'].max()}")


def _check_offset(path: Path, name: str, offset: np.ndarray, scenes: int, points: int) -> None:
    if len(offset) != scenes + 1 or offset[0] != 0 or offset[-1] != points or (offset[1:] < offset[:-1]).any():
        raise ValueError(f"{path}: {name} must rise from 0 to {points} points over {scenes} scenes")


def _check_kinds(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raise `ValueError` naming the shard and the array with wrong axes or a wrong kind of numbers."""
    for name in ARRAYS.keys() & arrays.keys():
        (kinds, axes), array = ARRAYS[name], arrays[name]
        if array.ndim != axes or array.dtype.kind not in kinds:
            raise ValueError(
                f"{path}: {name} must have {axes} axes and a dtype of kind {kinds}, got {array.dtype} {array.shape}"
            )


def _scan(path: Path, arrays: dict[str, np.ndarray], scene: int, index: int) -> Scan:
    names = ("profiles", "values")
    measured: dict[str, Any] = {name: arrays[name][scene] if name in arrays else None for name in names}
    for name, array in measured.items():
        if array is not None and not np.isfinite(array).all():
            raise ValueError(f"{path}: {name} of scene {scene} must be finite")
    try:
        facts = msgspec.json.decode(arrays["facts"][scene], type=_Facts) if "facts" in arrays else _Facts()
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise ValueError(f"{path}: facts of scene {scene}: {error}") from None
    missing = np.flatnonzero(arrays["missing_beams"][scene]) if "missing_beams" in arrays else ()
    return Scan(
        index=index,
        noise_power_mw=float(arrays["noise_power_mw"][scene]),
        missing_beams=tuple(int(beam) for beam in missing),
        labels=_labels(arrays, slice(*arrays["offset"][scene : scene + 2])),
        scene_yaml=str(arrays["scene_yaml"][scene]) if "scene_yaml" in arrays else "",
        sequence=str(arrays["sequence"][scene]) if "sequence" in arrays else "",
        places_m=arrays["places_m"][slice(*arrays["place_offset"][scene : scene + 2])]
        if "places_m" in arrays
        else None,
        ego=_ego(path, arrays["odometry"][scene], scene) if "odometry" in arrays else None,
        pose=Pose2(*arrays["pose"][scene].tolist()) if "pose" in arrays else None,
        radial_speed_mps=_speeds(path, arrays, scene),
        **msgspec.structs.asdict(facts),
        **measured,
    )


def _speeds(path: Path, arrays: dict[str, np.ndarray], scene: int) -> np.ndarray | None:
    """Return the radial speeds of a scan's profiles, float32 [beams, bins]; None where the shard has none."""
    if "radial_speed_cmps" not in arrays:
        return None
    codes = arrays["radial_speed_cmps"][scene]
    if "profiles" not in arrays or codes.shape != arrays["profiles"][scene].shape:
        raise ValueError(f"{path}: radial_speed_cmps must have the shape of the profiles, got {codes.shape} a scene")
    return mps_from_speed_codes(codes).astype(np.float32)


def _ego(path: Path, odometry: np.ndarray, scene: int) -> VehicleState:
    """Return the state at a scan's first beam, the first of rows (time, speed, yaw rate)."""
    if odometry.shape[0] < 1 or odometry.shape[1] != 3:
        raise ValueError(f"{path}: odometry of a scene must have rows of 3 numbers, got {odometry.shape}")
    _, speed_mps, yaw_rate_rps = odometry[0].tolist()
    try:
        return VehicleState(stamp_ns=0, speed_mps=speed_mps, yaw_rate_rps=yaw_rate_rps)
    except ValueError as error:
        raise ValueError(f"{path}: odometry of scene {scene}: {error}") from None


def _labels(arrays: dict[str, np.ndarray], points: slice) -> FrameLabels:
    count = points.stop - points.start
    unknown: dict[str, np.ndarray] = {
        "order": np.full(count, -1),
        "hidden_xy_m": np.full((count, 2), np.nan, np.float32),
        "power_mw": np.full(count, np.nan, np.float32),
        "object_index": np.full(count, -1),
        "object_class": np.full(count, ""),
    }
    return FrameLabels(
        **{
            field.name: arrays[field.name][points] if field.name in arrays else unknown[field.name]
            for field in fields(FrameLabels)
        }
    )


def fixed_splits(directory: Path, seed: int = 0) -> Splits:
    """Return training, validation and test scenes of a folder, by scene or by sequence; the same at every call.

    Written to `splits.json` at the first call and read from there later. Raises `ValueError` if the file cannot be
    read, does not cover the folder's scenes once each, leaks a scene from one split into another, or names other test
    scenes than the folder holds.
    """
    data = DataSet(directory)
    path = data.directory / "splits.json"
    if not path.exists():
        splits = _draw_splits(data, seed)
        write_whole(path, msgspec.json.encode(splits))
        return splits
    try:
        splits = msgspec.json.decode(path.read_bytes(), type=Splits)
    except (msgspec.DecodeError, UnicodeError) as error:
        raise ValueError(f"{path}: {error}") from None
    check_splits(data, splits, path)
    return splits


def _draw_splits(data: DataSet, seed: int) -> Splits:
    groups = _groups(data)
    names = np.unique(groups)
    if len(names) < len(SHARES):
        raise ValueError(f"{data.directory} must hold at least {len(SHARES)} scenes or sequences, got {len(names)}")
    order = np.random.default_rng(seed).permutation(len(names))
    last = np.rint(np.cumsum(SHARES) * len(names)).astype(int)
    last[0] = min(last[0], len(names) - 2)
    last[1] = min(max(last[1], last[0] + 1), len(names) - 1)
    parts = [np.flatnonzero(np.isin(groups, names[part])).tolist() for part in np.split(order, last[:2])]
    return Splits(
        seed=seed, train=parts[0], validation=parts[1], test=parts[2], test_sha256=scenes_sha256(data, parts[2])
    )


def _groups(data: DataSet) -> np.ndarray:
    """Return the sequence of each scene, or its own number if it belongs to none."""
    return np.array([data.scan(index).sequence or f"scene {index:09d}" for index in range(len(data))])


def scenes_sha256(data: DataSet, indices: Iterable[int]) -> str:
    """Return one hash over the fingerprints of scenes, in order."""
    return hashlib.sha256("".join(data.fingerprint(int(index)) for index in indices).encode()).hexdigest()


def check_splits(data: DataSet, splits: Splits, path: Path) -> None:
    """Raise `ValueError` unless the splits cover the data set once, share nothing, and test on the stated scenes."""
    split_of: dict[str, tuple[str, int]] = {}
    groups = _groups(data)
    for name in ("train", "validation", "test"):
        if not getattr(splits, name):
            raise ValueError(f"{path}: {name} must hold at least one scene, holds none")
        for index in splits.of(name):
            if not 0 <= index < len(data):
                raise ValueError(f"{path}: {name} must name scenes 0..{len(data) - 1}, got {index}")
            for key in (data.fingerprint(int(index)), str(groups[index])):
                other, first = split_of.setdefault(key, (name, int(index)))
                if other != name:
                    raise ValueError(
                        f"{path}: {other} and {name} must share no scene, scenes {first} and {index} "
                        f"are one ({groups[index]})"
                    )
    if len(splits.of("all")) != len(data):
        raise ValueError(f"{path} must name each of {len(data)} scenes once, names {len(splits.of('all'))}")
    sha256 = scenes_sha256(data, splits.test)
    if sha256 != splits.test_sha256:
        raise ValueError(f"{path}: test_sha256 must be {splits.test_sha256}, the test scenes have {sha256}")
