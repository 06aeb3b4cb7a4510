"""Raw captures as SigMF recordings (`ci16_le`), read and written beam by beam.

One `captures` entry is one beam of chirps x samples, without gaps in order of acquisition. `mirrorwave:background`
names a file beside the capture, complex64 [beams, samples] in int16 codes; `mirrorwave:steering_weights` of a beam is a
list of [re, im]. Any fault of a capture is one `ValueError` of one line: file, field, value, rule.
"""

from __future__ import annotations

import hashlib
import json
import math
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, NoReturn, Self

import msgspec
import numpy as np
from jsonschema.exceptions import ValidationError  # type: ignore[import-untyped]
from sigmf.validate import validate

from msgs.files.array_files import load_array
from msgs.files.text_files import decode_text
from msgs.files.whole_files import whole, write_whole
from msgs.values.radar import RadarBeam, RadarParams, RadarSetup
from msgs.values.units import ns_from_s
from msgs.values.wording import counted

EXTENSION = "mirrorwave"
DATATYPE = "ci16_le"
_SIGMF_VERSION = "1.2.0"
_EXTENSION_VERSION = "1.0.0"
_BYTES_PER_SAMPLE = 4
_META_SUFFIX, _DATA_SUFFIX = ".sigmf-meta", ".sigmf-data"
_BACKGROUND_SUFFIX = ".background.npy"
#: Some 100,000 beams; no capture of this project is larger.
_MAX_META_BYTES = 1 << 26
#: Captures, and annotations, in any metadata; and bytes of data a further one: less than the shortest beam has.
_FREE_SEGMENTS, _SEGMENT_BYTES = 10_000, 1 << 10
_MAX_ANGLE_ERROR_DEG = 1e-6
#: Tolerance between a beam's azimuth and its setup's, when written.
_MAX_ANGLE_ERROR_RAD = 1e-9
_MAX_INT = (1 << 63) - 1


class _Number(NamedTuple):
    """Permitted range of a number."""

    low: float
    high: float
    whole: bool = False

    def __str__(self) -> str:
        return f"a{' whole' if self.whole else ''} number from {self.low:g} to {self.high:g}"

    def permits(self, value: object) -> bool:
        kinds = int if self.whole else (int, float)
        return isinstance(value, kinds) and not isinstance(value, bool) and self.low <= value <= self.high


class _Flag(NamedTuple):
    """A truth value."""

    def __str__(self) -> str:
        return "true or false"

    def permits(self, value: object) -> bool:
        return isinstance(value, bool)


_POSITIVE = _Number(1e-12, 1e15)
_ANY = _Number(-1e15, 1e15)
_LEVEL_DB = _Number(-300.0, 300.0)
_COUNT = _Number(1, 1_000_000, whole=True)
_BEAMS = _Number(1, 4096, whole=True)
_INDEX = _Number(0, _MAX_INT, whole=True)
_ANGLE_DEG = _Number(-89.999, 89.999)

#: Optional global keys: part of the setup, field, permitted values. Absent keys leave the field at its default.
_OPTIONAL: dict[str, tuple[str, str, _Number | _Flag]] = {
    "array_columns": ("array", "columns", _Number(1, 1024, whole=True)),
    "array_rows": ("array", "rows", _Number(1, 1024, whole=True)),
    "column_spacing_m": ("array", "column_spacing_m", _POSITIVE),
    "row_spacing_m": ("array", "row_spacing_m", _POSITIVE),
    "phase_bits": ("array", "phase_bits", _Number(0, 16, whole=True)),
    "phases_from_centre": ("array", "phases_from_centre", _Flag()),
    "steered_ways": ("array", "steered_ways", _Number(1, 2, whole=True)),
    "array_digital": ("array", "digital", _Flag()),
    "element_azimuth_hpbw_deg": ("element", "azimuth_hpbw_deg", _POSITIVE),
    "element_elevation_hpbw_deg": ("element", "elevation_hpbw_deg", _POSITIVE),
    "element_peak_gain_dbi": ("element", "peak_gain_dbi", _LEVEL_DB),
    "element_sidelobe_floor_db": ("element", "sidelobe_floor_db", _LEVEL_DB),
    "transmit_power_w": ("radar", "transmit_power_w", _POSITIVE),
    "noise_figure_db": ("radar", "noise_figure_db", _LEVEL_DB),
    "scan_period_s": ("radar", "scan_period_s", _POSITIVE),
    "chirp_interval_s": ("radar", "chirp_interval_s", _POSITIVE),
    "beat_sign": ("setup", "beat_sign", _Number(-1, 1, whole=True)),
    "radar_height_m": ("setup", "radar_height_m", _ANY),
    "setup_stamp_ns": ("setup", "stamp_ns", _Number(-_MAX_INT, _MAX_INT, whole=True)),
}


class _Beam(NamedTuple):
    """Metadata of one beam."""

    scan_id: int
    beam_index: int
    stamp_ns: int


class SigmfCapture:
    """A capture on disk; `len` counts its beams, the last scan may be partial.

    Beams are read, not mapped: a mapped file that is cut while it is open would kill the process.
    """

    def __init__(self, data_path: Path, setup: RadarSetup, beams: list[_Beam]) -> None:
        self.path = data_path
        self.setup = setup
        self._beams = beams

    @classmethod
    def open(cls, path: Path, *, verify: bool = True) -> Self:
        """Read the metadata of a capture by its meta file, data file or stem, `verify` its data; `ValueError`."""
        meta_path, data_path = capture_paths(Path(path))
        metadata = _load_metadata(meta_path)
        fields = _Fields(meta_path, metadata)
        setup = fields.setup()
        beams = fields.beams(setup)
        _check_data(data_path, setup.radar, len(beams), metadata["global"].get("core:sha512") if verify else None)
        return cls(data_path, setup, beams)

    def __len__(self) -> int:
        return len(self._beams)

    def beams(self) -> Iterator[RadarBeam]:
        """Yield all beams in order of acquisition; each holds its own samples."""
        radar = self.setup.radar
        codes = radar.chirps_per_beam * radar.samples_per_chirp * 2
        with self.path.open("rb") as file:
            for at, beam in enumerate(self._beams):
                samples = np.fromfile(file, "<i2", codes)
                if len(samples) != codes:
                    raise ValueError(f"{self.path}: ends inside beam {at}: it was whole when it was opened")
                yield RadarBeam(
                    stamp_ns=beam.stamp_ns,
                    scan_id=beam.scan_id,
                    beam_index=beam.beam_index,
                    beam_count=len(self.setup.beams),
                    azimuth_rad=math.radians(self.setup.beams.azimuth_deg[beam.beam_index]),
                    samples=samples.reshape(radar.chirps_per_beam, radar.samples_per_chirp, 2),
                    full_scale_dbm=self.setup.full_scale_dbm,
                )


def capture_paths(path: Path) -> tuple[Path, Path]:
    """Return meta and data file of a capture named by either or by their common stem; both must be files."""
    name = path.name
    for suffix in (_META_SUFFIX, _DATA_SUFFIX):
        name = name.removesuffix(suffix)
    paths = path.with_name(name + _META_SUFFIX), path.with_name(name + _DATA_SUFFIX)
    for file in paths:
        if not file.is_file():
            raise ValueError(f"{file}: no such file; a capture is a {_META_SUFFIX} and a {_DATA_SUFFIX} file")
    return paths


def write_capture(
    path: Path, setup: RadarSetup, beams: Iterable[RadarBeam], *, overwrite: bool = False
) -> tuple[Path, Path]:
    """Write beams as they come and return the meta and data file; a failed write leaves neither.

    Raises `ValueError` for beams that are not the setup's, none at all, or out of order; `FileExistsError` if a file
    exists and `overwrite` was not asked for.
    """
    stem = Path(path).name.removesuffix(_META_SUFFIX).removesuffix(_DATA_SUFFIX)
    meta_path, data_path = (Path(path).with_name(stem + suffix) for suffix in (_META_SUFFIX, _DATA_SUFFIX))
    background_path = Path(path).with_name(stem + _BACKGROUND_SUFFIX)
    targets = [meta_path, data_path] + [background_path] * (setup.background is not None)
    for target in targets:
        if target.exists() and not overwrite:
            raise FileExistsError(f"{target}: exists already and is not overwritten unless asked")
    try:
        with whole(data_path) as part, part.open("wb") as file:
            captures, sha512 = _write_beams(file, setup, beams)
        metadata = {"global": _global_of(setup, sha512, background_path.name), "captures": captures, "annotations": []}
        _require_valid(metadata, meta_path)
        if setup.background is not None:
            with whole(background_path) as part, part.open("wb") as file:
                np.save(file, setup.background, allow_pickle=False)
        write_whole(meta_path, f"{json.dumps(metadata, indent=1, allow_nan=False)}\n".encode())
    except BaseException:
        for target in targets:
            target.unlink(missing_ok=True)
        raise
    return meta_path, data_path


class _Fields:
    """Checked access to a capture's metadata."""

    def __init__(self, meta_path: Path, metadata: dict[str, Any]) -> None:
        self._path = meta_path
        self._global: dict[str, Any] = metadata["global"]
        self._captures: list[dict[str, Any]] = metadata["captures"]
        self._require_ours()
        self._per_scan = int(self._number(self._global, "global", "mirrorwave:beams_per_scan", _BEAMS))

    def setup(self) -> RadarSetup:
        """Return the radar setup, with defaults for what the capture does not say."""
        parts: dict[str, dict[str, Any]] = {"radar": self._waveform(), "array": {}, "element": {}, "setup": {}}
        for key, (part, field, permitted) in _OPTIONAL.items():
            if f"mirrorwave:{key}" in self._global:
                parts[part][field] = self._number(self._global, "global", f"mirrorwave:{key}", permitted)
        fields = {
            **parts["setup"],
            "radar": parts["radar"],
            "array": parts["array"],
            "element": parts["element"],
            "beams": {"azimuth_deg": self._azimuths_deg()},
            "full_scale_dbm": self._number(self._global, "global", "mirrorwave:full_scale_dbm", _LEVEL_DB),
        }
        try:
            setup = msgspec.convert(fields, RadarSetup)
            return msgspec.structs.replace(
                setup, steering_weights=self._steering_weights(setup), background=self._background(setup)
            )
        except msgspec.ValidationError as error:
            raise ValueError(f"{self._path}: {error}") from error

    def beams(self, setup: RadarSetup) -> list[_Beam]:
        """Return scan, index and time of every beam; by order and by nominal timing if the capture does not say."""
        period_ns, interval_ns = ns_from_s(setup.radar.scan_period_s), setup.beam_interval_ns
        beams: list[_Beam] = []
        for at in range(len(self._captures)):
            scan_id, beam_index = self._scan_and_index(at)
            if beams and (scan_id, beam_index) <= beams[-1][:2]:
                self._fail(at, "mirrorwave:beam_index", beam_index, f"scan {scan_id} is past that beam already")
            first_scan = beams[0].scan_id if beams else scan_id
            nominal_ns = (scan_id - first_scan) * period_ns + beam_index * interval_ns
            stamp_ns = self._number(self._captures[at], at, "mirrorwave:stamp_ns", _INDEX, min(nominal_ns, _MAX_INT))
            beams.append(_Beam(scan_id, beam_index, int(stamp_ns)))
        return beams

    def _waveform(self) -> dict[str, Any]:
        number = self._number
        return {
            "carrier_hz": self._carrier_hz(),
            "bandwidth_hz": number(self._global, "global", "mirrorwave:chirp_bandwidth_hz", _POSITIVE),
            "sample_rate_hz": number(self._global, "global", "core:sample_rate", _POSITIVE),
            "chirps_per_beam": number(self._global, "global", "mirrorwave:chirps_per_beam", _COUNT),
            "samples_per_chirp": number(self._global, "global", "mirrorwave:samples_per_chirp", _COUNT),
        }

    def _require_ours(self) -> None:
        """Raise `ValueError` unless this program understands data type, layout and extension."""
        head = self._global
        if head.get("core:datatype") != DATATYPE:
            self._fail("global", "core:datatype", head.get("core:datatype"), f"must be {DATATYPE}")
        if head.get("core:num_channels", 1) != 1:
            self._fail("global", "core:num_channels", head["core:num_channels"], "must be 1")
        for key in ("core:dataset", "core:metadata_only", "core:trailing_bytes", "core:offset"):
            if head.get(key):
                self._fail("global", key, head[key], "must be absent: data stand alone in the file beside")
        if EXTENSION not in [extension["name"] for extension in head.get("core:extensions", [])]:
            self._fail("global", "core:extensions", head.get("core:extensions"), f"must name {EXTENSION}")
        if not self._captures:
            self._fail("captures", "captures", [], "must hold at least one beam")
        for at, capture in enumerate(self._captures):
            if capture.get("core:header_bytes"):
                self._fail(at, "core:header_bytes", capture["core:header_bytes"], "must be absent")

    def _scan_and_index(self, at: int) -> tuple[int, int]:
        """Return scan and index of a beam; check that its samples begin where they must."""
        capture = self._captures[at]
        count = _Number(0, self._per_scan - 1, whole=True)
        expected = at * int(self._global["mirrorwave:chirps_per_beam"] * self._global["mirrorwave:samples_per_chirp"])
        start = self._number(capture, at, "core:sample_start", _INDEX)
        if start != expected:
            self._fail(at, "core:sample_start", start, f"must be {expected}: beams follow each other without gaps")
        beam_index = self._number(capture, at, "mirrorwave:beam_index", count, at % self._per_scan)
        return int(self._number(capture, at, "mirrorwave:scan_id", _INDEX, at // self._per_scan)), int(beam_index)

    def _carrier_hz(self) -> float:
        carriers = [self._number(each, at, "core:frequency", _POSITIVE) for at, each in enumerate(self._captures)]
        for at, carrier_hz in enumerate(carriers):
            if carrier_hz != carriers[0]:
                self._fail(at, "core:frequency", carrier_hz, f"must be that of the first beam, {carriers[0]}")
        return float(carriers[0])

    def _azimuths_deg(self) -> list[float]:
        """Return the steering angle of each index of a scan; unreached indices follow the line through the rest."""
        angles_by_index: dict[int, float] = {}
        for at, capture in enumerate(self._captures):
            angle_deg = self._number(capture, at, "mirrorwave:azimuth_deg", _ANGLE_DEG)
            known_deg = angles_by_index.setdefault(self._scan_and_index(at)[1], float(angle_deg))
            if abs(known_deg - angle_deg) > _MAX_ANGLE_ERROR_DEG:
                self._fail(at, "mirrorwave:azimuth_deg", angle_deg, f"must be {known_deg} as in an earlier scan")
        if len(angles_by_index) == self._per_scan:
            return [angles_by_index[index] for index in range(self._per_scan)]
        return self._completed(angles_by_index)

    def _completed(self, angles_by_index: dict[int, float]) -> list[float]:
        indices = np.array(sorted(angles_by_index))
        angles_deg = np.array([angles_by_index[index] for index in sorted(angles_by_index)])
        rule = f"beams {len(angles_by_index)} of {self._per_scan} appear; a scan can be completed only if evenly spaced"
        if len(angles_by_index) < 2:
            self._fail("global", "mirrorwave:beams_per_scan", self._per_scan, rule)
        step_deg = (angles_deg[-1] - angles_deg[0]) / (indices[-1] - indices[0])
        line_deg = angles_deg[0] + step_deg * (np.arange(self._per_scan) - indices[0])
        if np.abs(line_deg[indices] - angles_deg).max() > _MAX_ANGLE_ERROR_DEG:
            self._fail("global", "mirrorwave:beams_per_scan", self._per_scan, rule)
        return [angles_by_index.get(index, float(line_deg[index])) for index in range(self._per_scan)]

    def _steering_weights(self, setup: RadarSetup) -> np.ndarray | None:
        """Return weights complex64 [beams, columns], None where no beam gives any."""
        key = "mirrorwave:steering_weights"
        if not any(key in capture for capture in self._captures):
            return None
        weights: dict[int, np.ndarray] = {}
        for at, capture in enumerate(self._captures):
            pairs = capture.get(key)
            given = _complex_pairs(pairs, setup.array.columns)
            if given is None:
                self._fail(at, key, pairs, f"must be {setup.array.columns} pairs [re, im] of finite numbers")
            earlier = weights.setdefault(self._scan_and_index(at)[1], given)
            if not np.array_equal(earlier, given):
                self._fail(at, key, pairs, "must be the same in every scan")
        if len(weights) != len(setup.beams):
            self._fail("global", "mirrorwave:beams_per_scan", self._per_scan, "every beam must give its weights")
        return np.stack([weights[index] for index in range(len(setup.beams))])

    def _background(self, setup: RadarSetup) -> np.ndarray | None:
        key = "mirrorwave:background"
        name = self._global.get(key)
        if name is None:
            return None
        if not isinstance(name, str) or Path(name).name != name or not name.endswith(".npy"):
            self._fail("global", key, name, "must name a .npy file beside the capture")
        shape = len(setup.beams), setup.radar.samples_per_chirp
        try:
            background = load_array(self._path.with_name(name))
        except (OSError, ValueError) as error:
            self._fail("global", key, name, f"cannot be read ({' '.join(str(error).split())})")
        if background.dtype.str != "<c8" or background.shape != shape:
            self._fail("global", key, name, f"must hold complex64 {shape}, not {background.dtype} {background.shape}")
        if not np.isfinite(background).all():
            self._fail("global", key, name, "must be finite")
        return background

    def _number(
        self,
        section: dict[str, Any],
        where: str | int,
        key: str,
        permitted: _Number | _Flag,
        default: float | None = None,
    ) -> Any:
        """Return a number of the metadata; integers stay exact."""
        value = section.get(key, default)
        if value is None:
            self._fail(where, key, value, f"is required and must be {permitted}")
        if not permitted.permits(value):
            self._fail(where, key, value, f"must be {permitted}")
        return value

    def _fail(self, where: str | int, key: str, value: object, rule: str) -> NoReturn:
        location = f"captures[{where}]" if isinstance(where, int) else where
        raise ValueError(f"{self._path}: {location}: {key} is {_short(value)}: {rule}")


def _load_metadata(meta_path: Path) -> dict[str, Any]:
    """Return the metadata, valid SigMF."""
    if meta_path.stat().st_size > _MAX_META_BYTES:
        raise ValueError(f"{meta_path}: {meta_path.stat().st_size} bytes exceed {_MAX_META_BYTES}")
    try:
        metadata: dict[str, Any] = json.loads(decode_text(meta_path.read_bytes()), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{meta_path}: must be JSON: {error}") from error
    data_path = meta_path.with_suffix(".sigmf-data")
    data_bytes = data_path.stat().st_size if data_path.is_file() else 0
    limit = _FREE_SEGMENTS + data_bytes // _SEGMENT_BYTES
    for name in ("captures", "annotations"):
        segments = metadata.get(name) if isinstance(metadata, dict) else None
        if isinstance(segments, list) and len(segments) > limit:
            rule = f"must be at most {limit} for {counted(data_bytes, 'byte')} of data, got {len(segments)}"
            raise ValueError(f"{meta_path}: {name} {rule}")
    _require_valid(metadata, meta_path)
    return metadata


def _require_valid(metadata: dict[str, Any], meta_path: Path) -> None:
    """Raise `ValueError` unless `metadata` are valid SigMF."""
    try:
        with warnings.catch_warnings():
            # undeclared extensions of other programs do not matter; our own is required
            warnings.simplefilter("ignore", DeprecationWarning)
            validate(metadata)
    except ValidationError as error:
        raise ValueError(f"{meta_path}: {_schema_complaint(error)}") from error
    except (KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{meta_path}: must be SigMF metadata: {type(error).__name__} {error}") from error


def _schema_complaint(error: ValidationError) -> str:
    location = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in error.absolute_path)
    value = f" is {_short(error.instance)}" if isinstance(error.instance, str | float | int | None) else ""
    return f"{location.lstrip('.') or 'metadata'}{value}: {_short(error.message, quote=str)}"


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a JSON number")


def _short(value: object, quote: Callable[[object], str] = repr) -> str:
    text = " ".join(quote(value).split())
    return text if len(text) <= 120 else f"{text[:117]}..."


def _check_data(data_path: Path, radar: RadarParams, beams: int, sha512: str | None) -> None:
    """Check the size, and the checksum if given, of the data file."""
    size = data_path.stat().st_size
    needed = beams * radar.chirps_per_beam * radar.samples_per_chirp * _BYTES_PER_SAMPLE
    if size != needed:
        raise ValueError(
            f"{data_path}: size is {size} bytes: must be {needed}, {beams} beams of "
            f"{radar.chirps_per_beam} x {radar.samples_per_chirp} samples of {_BYTES_PER_SAMPLE} bytes"
        )
    if sha512 is None:
        return
    with data_path.open("rb") as file:
        actual = hashlib.file_digest(file, "sha512").hexdigest()
    if actual != sha512.lower():
        raise ValueError(f"{data_path}: data are damaged: sha512 is {actual[:16]}..., core:sha512 {sha512[:16]}...")


def _complex_pairs(pairs: object, count: int) -> np.ndarray | None:
    """Return complex64 [count] of a list of [re, im], None for anything else."""
    if not isinstance(pairs, list) or len(pairs) != count:
        return None
    if not all(isinstance(pair, list) and len(pair) == 2 and all(map(_ANY.permits, pair)) for pair in pairs):
        return None
    return np.array([complex(*pair) for pair in pairs], "<c8")


def _write_beams(file: BinaryIO, setup: RadarSetup, beams: Iterable[RadarBeam]) -> tuple[list[dict[str, Any]], str]:
    """Append all beams; return their `captures` entries and the checksum of their data."""
    captures: list[dict[str, Any]] = []
    sha512 = hashlib.sha512()
    last: tuple[int, int] | None = None
    for beam in beams:
        _require_of_setup(beam, setup)
        position = beam.scan_id, beam.beam_index
        if last is not None and position <= last:
            raise ValueError(f"beam.beam_index must rise within a scan: scan and beam {position} after {last}")
        data = np.ascontiguousarray(beam.samples).data
        sha512.update(data)
        file.write(data)
        captures.append(_capture_of(beam, setup, len(captures)))
        last = position
    if not captures:
        raise ValueError("beams must be at least one: a capture cannot be empty")
    return captures, sha512.hexdigest()


def _require_of_setup(beam: RadarBeam, setup: RadarSetup) -> None:
    shape = setup.radar.chirps_per_beam, setup.radar.samples_per_chirp, 2
    if beam.samples.shape != shape:
        raise ValueError(f"beam.samples must have the setup's shape {shape}, got {beam.samples.shape}")
    if beam.beam_count != len(setup.beams):
        raise ValueError(f"beam.beam_count must be the setup's {len(setup.beams)}, got {beam.beam_count}")
    if beam.full_scale_dbm != setup.full_scale_dbm:
        raise ValueError(f"beam.full_scale_dbm must be the setup's {setup.full_scale_dbm}, got {beam.full_scale_dbm}")
    azimuth_rad = math.radians(setup.beams.azimuth_deg[beam.beam_index])
    if abs(beam.azimuth_rad - azimuth_rad) > _MAX_ANGLE_ERROR_RAD:
        raise ValueError(f"beam.azimuth_rad must be the setup's {azimuth_rad}, got {beam.azimuth_rad}")
    if beam.stamp_ns < 0:
        raise ValueError(f"beam.stamp_ns must not be negative, got {beam.stamp_ns}")


def _capture_of(beam: RadarBeam, setup: RadarSetup, at: int) -> dict[str, Any]:
    capture: dict[str, Any] = {
        "core:sample_start": at * setup.radar.chirps_per_beam * setup.radar.samples_per_chirp,
        "core:frequency": setup.radar.carrier_hz,
        "mirrorwave:azimuth_deg": setup.beams.azimuth_deg[beam.beam_index],
        "mirrorwave:stamp_ns": beam.stamp_ns,
        "mirrorwave:scan_id": beam.scan_id,
        "mirrorwave:beam_index": beam.beam_index,
    }
    if setup.steering_weights is not None:
        weights = setup.steering_weights[beam.beam_index]
        capture["mirrorwave:steering_weights"] = [[weight.real.item(), weight.imag.item()] for weight in weights]
    return capture


def _global_of(setup: RadarSetup, sha512: str, background_name: str) -> dict[str, Any]:
    parts = {"radar": setup.radar, "array": setup.array, "element": setup.element, "setup": setup}
    optional = {f"mirrorwave:{key}": getattr(parts[part], field) for key, (part, field, _) in _OPTIONAL.items()}
    if setup.background is not None:
        optional["mirrorwave:background"] = background_name
    return {
        "core:datatype": DATATYPE,
        "core:sample_rate": setup.radar.sample_rate_hz,
        "core:version": _SIGMF_VERSION,
        "core:num_channels": 1,
        "core:sha512": sha512,
        "core:extensions": [{"name": EXTENSION, "version": _EXTENSION_VERSION, "optional": False}],
        "mirrorwave:chirp_bandwidth_hz": setup.radar.bandwidth_hz,
        "mirrorwave:chirps_per_beam": setup.radar.chirps_per_beam,
        "mirrorwave:samples_per_chirp": setup.radar.samples_per_chirp,
        "mirrorwave:beams_per_scan": len(setup.beams),
        "mirrorwave:full_scale_dbm": setup.full_scale_dbm,
        **{key: value for key, value in optional.items() if value is not None},
    }
