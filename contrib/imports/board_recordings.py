"""`mirrorwave import board`: raw recordings of two boards as the set-up and beams of a row of two receivers.

Infineon BGT60TR13C, as Radar Fusion GUI and Radar SDK save it: `config.json` and `radar.npy`, [frames, receivers,
chirps, samples], real samples of 12 bits or shares of their full scale. Receivers 1 and 3 lie in a row; 2 is above 3.

Ancortek SDR kits: a `.dat` of one number a line: middle of the sweep [Hz], sweep time [ms], samples of a sweep,
bandwidth [Hz], then complex values `a+bi`, those of two receivers in turn. How many there are is not in the file: what
stands still comes again with the next sweep of the same receiver, which tells two from one.

The layouts are those that published readers take; neither board was at hand.
"""

from __future__ import annotations

import cmath
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np

from contrib.boards.dca1000_capture import FileFrames, analytic, value_at
from contrib.boards.digital_row import beam_codes, write_scans
from msgs.files.array_files import array_header
from msgs.files.checksums import file_sha256
from msgs.values.radar import FULL_SCALE_CODE, ArrayParams, RadarParams, RadarSetup, orthogonal_beams
from msgs.values.units import SPEED_OF_LIGHT_MPS
from msgs.values.wording import as_utf8, counted

MAX_CONFIG_BYTES, MAX_TEXT_BYTES = 1 << 20, 1 << 28
#: Of Infineon's receivers 1 and 3.
SPACING_M = 2.5e-3
#: Names of older versions of the SDK.
_FORMER_NAMES = {"lower_frequency_Hz": "start_frequency_Hz", "upper_frequency_Hz": "end_frequency_Hz"}
_CODES_12_BIT = 4096.0
#: Ancortek's sweeps follow without frames; so many make a scan.
SWEEPS_PER_SCAN = 32
_HEADER = ("carrier [Hz]", "sweep time [ms]", "samples of a sweep", "bandwidth [Hz]")

Positive = Annotated[float, msgspec.Meta(gt=0)]


class BoardRecording(NamedTuple):
    """What files hold; `frames` are complex64 [chirps, receivers from right to left, samples] in codes."""

    board: str
    files: tuple[Path, ...]
    radar: RadarParams
    spacing_m: float
    scans: int
    frames: Iterator[np.ndarray]
    loss: str | None
    #: What the files do not say.
    assumed: str


class FmcwSingleShape(msgspec.Struct, frozen=True, kw_only=True, rename=lambda name: name.replace("_hz", "_Hz")):
    """Chirps and frames of Infineon's `config.json`."""

    rx_antennas: tuple[int, ...]
    start_frequency_hz: Positive
    end_frequency_hz: Positive
    num_samples_per_chirp: Annotated[int, msgspec.Meta(ge=2, multiple_of=2)]
    num_chirps_per_frame: Annotated[int, msgspec.Meta(ge=1)]
    sample_rate_hz: Positive
    chirp_repetition_time_s: Positive
    frame_repetition_time_s: Positive

    def __post_init__(self) -> None:
        if not {1, 3} <= set(self.rx_antennas):
            raise ValueError(f"rx_antennas must name 1 and 3, which lie in a row, got {list(self.rx_antennas)}")
        start_hz, end_hz, frame_s = self.start_frequency_hz, self.end_frequency_hz, self.frame_repetition_time_s
        if end_hz <= start_hz:
            raise ValueError(f"end_frequency_Hz must be above start_frequency_Hz, {start_hz!r}, got {end_hz!r}")
        chirps_s = self.num_chirps_per_frame * self.chirp_repetition_time_s
        if chirps_s > frame_s * (1.0 + 1e-9):
            raise ValueError(f"frame_repetition_time_s must hold all chirps, {chirps_s:g}, got {frame_s:g}")


def import_board(path: Path, out: Path, progress: Callable[[str, int], Any]) -> dict[str, Any]:
    """Write set-up and beams of `path`, told by its content, to `out`; returns counts, loss and what was assumed.

    Raises `ValueError` that names file, field, value and rule. Levels are not measured: they hold within a recording.
    """
    recording = _infineon(path) if path.is_dir() else _ancortek(path)
    spacing_m = recording.spacing_m
    array = ArrayParams(columns=2, rows=1, column_spacing_m=spacing_m, phase_bits=0, steered_ways=1, digital=True)
    setup = RadarSetup(radar=recording.radar, array=array, beams=orthogonal_beams(2), full_scale_dbm=-20.0)
    files = {as_utf8(file.name): file_sha256(file) for file in recording.files}
    attributes = {"import": "board", "board": recording.board, "sha256": json.dumps(files)}
    scans = (beam_codes(frame, setup) for frame in recording.frames)
    with progress("scans", recording.scans) as advance:
        beams = write_scans(out, attributes, setup, scans, advance)
    return {name: getattr(recording, name) for name in ("board", "scans", "loss", "assumed")} | {"beams": beams}


def _radar(path: Path, **fields: Any) -> RadarParams:
    try:
        return RadarParams(**fields)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _infineon(folder: Path) -> BoardRecording:
    inner = [folder] if (folder / "radar.npy").exists() else sorted(folder.glob("RadarIfxAvian_*"))
    if len(inner) != 1:
        raise ValueError(f"{folder}: must be or hold one folder RadarIfxAvian_NN with radar.npy, got {len(inner)}")
    config, path = inner[0] / "config.json", inner[0] / "radar.npy"
    shape = _shape(config)
    wanted = (len(shape.rx_antennas), shape.num_chirps_per_frame, shape.num_samples_per_chirp)
    try:
        stored, dtype, start = array_header(path)
    except ValueError as error:
        raise ValueError(f"{path}: must be a NumPy array: {error}") from None
    if len(stored) != 4 or stored[1:] != wanted or dtype.kind not in "fiu":
        rule = f"must hold real numbers [frames, {', '.join(map(str, wanted))}], as config.json says"
        raise ValueError(f"{path}: {rule}, got {dtype} {list(stored)}")
    size, frame_bytes = path.stat().st_size - start, math.prod(wanted) * dtype.itemsize
    whole = min(stored[0], size // frame_bytes)
    if not whole:
        raise ValueError(f"{path}: must hold a whole frame of {frame_bytes} bytes, got {size}")
    # half as many complex samples, at half the rate, come of real ones
    radar = _radar(
        config,
        carrier_hz=shape.start_frequency_hz,
        bandwidth_hz=shape.end_frequency_hz - shape.start_frequency_hz,
        sample_rate_hz=shape.sample_rate_hz / 2,
        chirps_per_beam=shape.num_chirps_per_frame,
        samples_per_chirp=shape.num_samples_per_chirp // 2,
        scan_period_s=shape.frame_repetition_time_s,
        chirp_interval_s=shape.chirp_repetition_time_s,
    )
    # from right to left
    receivers = [shape.rx_antennas.index(3), shape.rx_antennas.index(1)]
    layout = FileFrames(whole, stored[0], size - whole * frame_bytes if whole < stored[0] else 0)
    assumed = "receiver 1 is to the left of 3 as the radar looks, with receiver 2 above 3"
    frames = (analytic(each[receivers]).swapaxes(0, 1) for each in _real_frames(path, start, whole, wanted, dtype))
    return BoardRecording("bgt60tr13c", (config, path), radar, SPACING_M, whole, frames, layout.loss, assumed)


def _shape(config: Path) -> FmcwSingleShape:
    if (size := config.stat().st_size) > MAX_CONFIG_BYTES:
        raise ValueError(f"{config}: must have at most {MAX_CONFIG_BYTES} bytes, got {size}")
    fields: Any = None
    try:
        fields = msgspec.json.decode(config.read_bytes())
        for name in ("device_config", "fmcw_single_shape"):
            fields = fields.get(name, fields) if isinstance(fields, dict) else fields
        if isinstance(fields, dict):
            fields = {_FORMER_NAMES.get(name, name): value for name, value in fields.items()}
        return msgspec.convert(fields, FmcwSingleShape)
    except msgspec.ValidationError as error:
        raise ValueError(f"{config}: {error}{value_at(fields, str(error))}") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{config}: must be JSON: {error}") from None


def _real_frames(path: Path, start: int, count: int, shape: tuple[int, ...], dtype: np.dtype) -> Iterator[np.ndarray]:
    """Frames float32 [receivers, chirps, samples] without their mean, in codes."""
    full_scale, size = 0.0, math.prod(shape) * dtype.itemsize
    with path.open("rb") as file:
        file.seek(start)
        for index in range(count):
            content = file.read(size)
            if len(content) != size:
                raise ValueError(f"{path}: ends inside frame {index}: it was whole when it was opened")
            frame = np.frombuffer(content, dtype).reshape(shape)
            low, high = frame.min(), frame.max()
            full_scale = full_scale or (1.0 if high <= 1.0 else _CODES_12_BIT)
            if not (low >= 0.0 and high <= full_scale):
                raise ValueError(f"{path}: frame {index}: samples must be 0..{full_scale:g}, got {low:g}..{high:g}")
            codes = frame.astype(np.float32) * np.float32(FULL_SCALE_CODE / full_scale)
            yield codes - codes.mean(axis=(1, 2), keepdims=True)


def _ancortek(path: Path) -> BoardRecording:
    (carrier_hz, sweep_ms, samples, bandwidth_hz), values = _numbers(path)
    if samples % 1.0 or not len(values) or len(values) % samples:
        raise ValueError(f"{path}: must hold whole sweeps of {samples:g} values, got {len(values)} values")
    _require_two_channels(path, values, int(samples))
    sweeps = values.reshape(-1, int(samples), 2)
    # two receivers in phase make a beam of the root of two
    sweeps -= sweeps.mean(axis=(0, 1))
    sweeps *= np.float32((FULL_SCALE_CODE - 1) / math.sqrt(2.0) / max(np.abs(sweeps).max(), 1e-30))
    chirps = min(SWEEPS_PER_SCAN, len(sweeps))
    scans, left = divmod(len(sweeps), chirps)
    radar = _radar(
        path,
        carrier_hz=carrier_hz - bandwidth_hz / 2,
        bandwidth_hz=bandwidth_hz,
        sample_rate_hz=1e3 * samples / sweep_ms,
        chirps_per_beam=chirps,
        samples_per_chirp=int(samples),
        scan_period_s=1e-3 * sweep_ms * chirps,
    )
    frames = (sweeps[at * chirps : (at + 1) * chirps].swapaxes(1, 2) for at in range(scans))
    loss = f"{counted(left, 'sweep')} after the last whole scan of {chirps} left out" if left else None
    assumed = (
        "two receivers, as values come again after two sweeps rather than one; half a wavelength apart, the first on "
        "the right as the radar looks"
    )
    half_m = SPEED_OF_LIGHT_MPS / (2.0 * carrier_hz)
    return BoardRecording("ancortek", (path,), radar, half_m, scans, frames, loss, assumed)


def _numbers(path: Path) -> tuple[list[float], np.ndarray]:
    """Return the four numbers of the header and the values, complex64."""
    if (size := path.stat().st_size) > MAX_TEXT_BYTES or not path.is_file():
        raise ValueError(f"{path}: must be a file of at most {MAX_TEXT_BYTES} bytes, got {size}")
    header, parts = [], [np.empty(0, np.complex64)]
    with path.open("rb") as file:
        for number, name in enumerate(_HEADER, start=1):
            value = _number(path, number, file.readline(), name)
            if value.imag or value.real <= 0.0:
                raise ValueError(f"{path}: line {number}: {name} must be real and positive, got {value:g}")
            header.append(value.real)
        number += 1
        while lines := file.readlines(1 << 20):
            each = [_number(path, at, line, "a value") for at, line in enumerate(lines, start=number) if line.strip()]
            parts.append(np.array(each, np.complex64))
            number += len(lines)
    return header, np.concatenate(parts)


def _number(path: Path, line_number: int, line: bytes, name: str) -> complex:
    try:
        value = complex(line.decode("ascii").replace(" ", "").replace("i", "j"))
    except ValueError:
        value = complex(math.nan)
    # what is larger has no square in single precision
    if not (cmath.isfinite(value) and abs(value) < 1e18):
        got = repr(line[:40])[1:]
        raise ValueError(f"{path}: line {line_number}: {name} must be a finite number such as 1 or 1+2i, got {got}")
    return value


def _require_two_channels(path: Path, values: np.ndarray, samples: int) -> None:
    """Raise `ValueError` unless values change from a sweep to the next but one far less than to the next.

    Something that is stronger than all else that moves and turns by half a wave a sweep deceives it.
    """
    reason = f"values change after one sweep of {samples} hardly more than after two"
    if len(values) % (2 * samples) or len(values) < 4 * samples:
        reason = f"{len(values) // samples} sweeps are not two or more of each of two"
    else:
        sweeps = values.reshape(-1, samples)
        at = np.linspace(0, len(sweeps) - 3, 512).astype(int)
        change = [np.square(np.abs(sweeps[at + lag] - sweeps[at]), dtype=np.float64).mean() for lag in (1, 2)]
        if change[1] < 0.25 * change[0]:
            return
    raise ValueError(f"{path}: must hold two channels, as one has no directions: {reason}")
