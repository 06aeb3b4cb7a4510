"""`mirrorwave import dca1000`: a raw 77 GHz capture as range-azimuth maps, a picture and the strongest returns."""

from __future__ import annotations

import contextlib
import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np

from contrib.boards.dca1000_capture import DEVICES, Dca1000Config, FileFrames, array_params, frame_samples, map_grid
from contrib.boards.digital_array import DigitalArrayMap, form_digital_map
from contrib.boards.digital_row import radar_setup, row_beams, write_scans
from models.perception.find.peaks import keep_apart, local_maxima
from msgs.files.checksums import file_sha256, json_lines
from msgs.files.whole_files import whole, write_whole
from msgs.values.units import db_from_ratio, ns_from_s, ratio_from_db
from msgs.values.wording import as_utf8

#: Maps of 512 x 256 cells take 1.5 MiB a frame.
FRAMES_PER_FILE = 50
#: Returns lie further apart than this in range or azimuth: Hann's main lobe, and that of eight channels at broadside.
SPACING_CELLS = (2, 32)
#: Weaker maxima may be noise: of the 4 million values that a map is chosen from (Doppler bins), the strongest lies some
#: 12 dB over their mean.
LEAST_SNR_DB = 15.0
DYNAMIC_RANGE_DB = 45.0


#: Strongest returns that are listed of a frame.
RETURNS = 5


@dataclass(frozen=True, kw_only=True)
class ImportParams:
    """Parameters of an import; `min_range_m` leaves the transmitters' own leakage out of the list of returns."""

    remove_static: bool = False
    mirrored: bool = False
    min_range_m: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.min_range_m) and self.min_range_m >= 0.0):
            raise ValueError(f"min_range_m must be finite and not negative, got {self.min_range_m!r}")


@dataclass(frozen=True)
class ImportedFrame:
    """A frame's map, its strongest returns and the share of its samples that reach the end of the scale."""

    formed: DigitalArrayMap
    returns: list[dict[str, float]]
    saturated_share: float


#: Names of the files that the card's tool begins anew at 1 GB, anywhere in a frame.
_RAW_NAME = re.compile(r"(?P<stem>.*_raw_)(?P<number>\d+)(?P<end>\.bin)", re.IGNORECASE)


#: Beginnings of the names of a cascade's files, by device.
_PARTS = ("master", "slave1", "slave2", "slave3")


def capture_files(given: Sequence[Path], config: Dca1000Config) -> list[Path]:
    """Return the files of one capture in order: those given, or `..._Raw_0.bin` with as many that follow as it needs,
    or those of the devices of a cascade beside the master's.

    Raises `ValueError` for a file that goes on where another ended or that is missing between two, `OSError` where one
    cannot be read.
    """
    files = list(given)
    if (parts := DEVICES[config.device].parts) > 1:
        if len(files) == 1 and files[0].name.startswith(_PARTS[0]):
            files = [files[0].with_name(part + files[0].name.removeprefix(_PARTS[0])) for part in _PARTS]
        if len(files) != parts:
            raise ValueError(f"{files[0]}: must be the file of the master, or all {parts}, got {len(files)}")
        return files
    met = _RAW_NAME.fullmatch(files[0].name)
    if met is not None and int(met["number"]):
        first = f"{met['stem']}0{met['end']}"
        raise ValueError(
            f"{files[0]}: goes on anywhere in a frame of the capture that begins with {first}: give that one, "
            "or all files in their order"
        )
    wanted = config.frame.frames * config.frame_bytes
    while met is not None and len(given) == 1:
        if 0 < wanted <= sum(file.stat().st_size for file in files):
            break
        following = files[0].with_name(f"{met['stem']}{len(files)}{met['end']}")
        if not following.is_file():
            if following.with_name(f"{met['stem']}{len(files) + 1}{met['end']}").is_file():
                raise ValueError(
                    f"{following}: is missing between files of one capture; to read some give each of them"
                )
            break
        files.append(following)
    return files


def capture_bytes(files: Sequence[Path], config: Dca1000Config) -> int:
    """Return the bytes of a capture's frames: of devices with a file each, as many as all have."""
    sizes = [file.stat().st_size for file in files]
    return min(sizes) * len(sizes) if DEVICES[config.device].parts > 1 else sum(sizes)


def import_capture(
    files: Sequence[Path],
    config_path: Path,
    config: Dca1000Config,
    out: Path,
    params: ImportParams,
    layout: FileFrames,
    on_frame: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Write `maps-NNNNN.npz`, `ra_map.png` and, last, `summary.json`; returns the summary.

    Raises `ValueError` where `out` holds something, the capture is cut while it is read, or one loop a frame leaves
    nothing beside what stands still.
    """
    if params.remove_static and config.frame.loops < 2:
        raise ValueError(f"{config_path}: frameCfg.loops must be at least 2 to remove what stands still, got 1")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"{out}: must be a new or an empty folder")
    provenance = _provenance(files, config_path, config)
    out.mkdir(parents=True, exist_ok=True)
    listed: list[dict[str, Any]] = []
    held: list[ImportedFrame] = []
    for index, frame in enumerate(_frames(files, config, params, layout.whole)):
        if index == 0:
            _draw(frame, out / "ra_map.png", as_utf8(files[0].name))
        listed.append({"frame": index, "saturated_share": frame.saturated_share, "returns": frame.returns})
        held.append(frame)
        if len(held) == FRAMES_PER_FILE or index == layout.whole - 1:
            _write_maps(out / f"maps-{index // FRAMES_PER_FILE:05d}.npz", held)
            held = []
        on_frame()
    summary = {
        "frames": layout.whole,
        "frames_wanted": layout.wanted,
        "left_bytes": layout.left_bytes,
        "loss": layout.loss,
        **_described(config),
        **vars(params),
        "provenance": provenance,
        "per_frame": listed,
    }
    write_whole(out / "summary.json", json_lines(summary))
    return summary


def write_recording(
    files: Sequence[Path],
    config_path: Path,
    config: Dca1000Config,
    out: Path,
    params: ImportParams,
    layout: FileFrames,
    on_frame: Callable[[], None] = lambda: None,
) -> int:
    """Write set-up and beams of all frames, at the times that the configuration gives them, to the new recording `out`.

    Returns the number of beams. Raises `ValueError` where the board's row is none of a digital array.
    """
    setup, array = radar_setup(config, mirrored=params.mirrored), array_params(config, mirrored=params.mirrored)
    provenance = {key: json.dumps(each) for key, each in _provenance(files, config_path, config).items()}
    scans = (row_beams(frame_samples(codes, config), setup, array) for codes in _codes(files, config, layout.whole))
    return write_scans(out, {"import": "dca1000", **provenance}, setup, scans, on_frame)


def _provenance(files: Sequence[Path], config_path: Path, config: Dca1000Config) -> dict[str, Any]:
    parts = [{"name": as_utf8(file.name), "bytes": file.stat().st_size, "sha256": file_sha256(file)} for file in files]
    return {
        "capture": parts[0],
        **({"continued": parts[1:]} if parts[1:] else {}),
        "configuration": {
            "name": config_path.name,
            "sha256": file_sha256(config_path),
            "fields": msgspec.to_builtins(config),
        },
    }


def _described(config: Dca1000Config) -> dict[str, Any]:
    """Return what follows from the configuration, for people and for readers of the maps."""
    params = array_params(config)
    speeds_mps = params.closing_speed_mps(config.frame.loops)
    used = {config.transmitters[at] for at in config.used_chirps}
    return {
        "device": config.device,
        "lanes": config.lanes,
        "channels": len(params.channel_y_m),
        "left_out_transmitters": sorted(
            {transmitter + 1 for transmitter in config.transmitters if transmitter not in used}
        ),
        "grid": msgspec.to_builtins(map_grid(config)),
        "carrier_hz": params.carrier_hz,
        "speed_bin_mps": 0.5 * params.wavelength_m / (params.repetition_interval_s * config.frame.loops),
        "speed_limit_mps": float(np.abs(speeds_mps).max()),
    }


def _frames(files: Sequence[Path], config: Dca1000Config, params: ImportParams, count: int) -> Iterator[ImportedFrame]:
    array, grid = array_params(config, params.remove_static, params.mirrored), map_grid(config)
    period_ns = ns_from_s(1e-3 * config.frame.period_ms)
    for index, codes in enumerate(_codes(files, config, count)):
        formed = form_digital_map(frame_samples(codes, config), array, grid, index * period_ns, index)
        saturated = float(np.mean((codes == 32767) | (codes == -32768)))
        yield ImportedFrame(formed, strongest_returns(formed, params), saturated)


def _codes(files: Sequence[Path], config: Dca1000Config, count: int) -> Iterator[np.ndarray]:
    """Codes of each frame, int16 [frame_bytes / 2]; a frame may begin in one file and end in the next."""
    parts = DEVICES[config.device].parts
    share = config.frame_bytes // parts
    with contextlib.ExitStack() as stack:
        opened = [stack.enter_context(file.open("rb")) for file in files]
        streams: list[list[BinaryIO]] = [[file] for file in opened] if parts > 1 else [[*opened]]
        for index in range(count):
            content = b"".join(_next_bytes(stream, share) for stream in streams)
            if len(content) != config.frame_bytes:
                raise ValueError(f"{files[-1]}: ends inside frame {index}: it was whole when it was opened")
            yield np.frombuffer(content, "<i2")


def _next_bytes(files: list[BinaryIO], size: int) -> bytes:
    """Return the next bytes of files that follow each other, fewer at their end; those that ended leave the list."""
    content = b""
    while len(content) < size and files:
        content += files[0].read(size - len(content))
        if len(content) < size:
            del files[0]
    return content


def strongest_returns(formed: DigitalArrayMap, params: ImportParams) -> list[dict[str, float]]:
    """The strongest maxima of a map over 15 dB of its noise, strongest first; nothing is fitted between cells."""
    grid, noise_mw = formed.map.grid, formed.map.noise_power_mw
    power = np.square(np.abs(formed.map.values), dtype=np.float64)
    power[grid.range_m < params.min_range_m] = 0.0
    # a silent frame has neither noise nor returns
    threshold = max(noise_mw * ratio_from_db(LEAST_SNR_DB), 1e-30)
    maxima = local_maxima(power, threshold, SPACING_CELLS[0])
    cells = maxima[keep_apart(maxima, SPACING_CELLS)[:RETURNS]]
    return [
        {
            "range_m": float(grid.range_m[row]),
            "azimuth_deg": math.degrees(grid.azimuth_rad[column]),
            "closing_speed_mps": float(formed.closing_speed_mps[row, column]),
            "snr_db": float(db_from_ratio(power[row, column] / max(noise_mw, 1e-30))),
        }
        for row, column in cells
    ]


def _write_maps(path: Path, frames: list[ImportedFrame]) -> None:
    maps = [frame.formed.map for frame in frames]
    arrays = {
        "values": np.stack([ra_map.values for ra_map in maps]),
        "closing_speed_mps": np.stack([frame.formed.closing_speed_mps for frame in frames]),
        "noise_power_mw": np.array([ra_map.noise_power_mw for ra_map in maps]),
        "stamp_ns": np.array([ra_map.stamp_ns for ra_map in maps], np.int64),
        "scan_id": np.array([ra_map.scan_id for ra_map in maps], np.int64),
        "saturated_share": np.array([frame.saturated_share for frame in frames]),
        "range_m": maps[0].grid.range_m,
        "azimuth_rad": maps[0].grid.azimuth_rad,
    }
    with whole(path) as part, part.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _draw(frame: ImportedFrame, out_path: Path, name: str) -> None:
    """The first frame's map, level over noise, with its strongest returns."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    ra_map = frame.formed.map
    power = np.square(np.abs(ra_map.values), dtype=np.float64)
    level_db = 10.0 * np.log10(np.maximum(power, 1e-30) / max(ra_map.noise_power_mw, 1e-30))
    figure = Figure(figsize=(7.5, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    mesh = axes.pcolormesh(
        np.degrees(ra_map.grid.azimuth_rad), ra_map.grid.range_m, level_db, cmap="cividis", shading="nearest",
        vmin=level_db.max() - DYNAMIC_RANGE_DB, vmax=level_db.max(), rasterized=True,
    )  # fmt: skip
    figure.colorbar(mesh, ax=axes, label="level over noise [dB]")
    axes.scatter(
        [echo["azimuth_deg"] for echo in frame.returns], [echo["range_m"] for echo in frame.returns],
        s=60, facecolors="none", edgecolors="#D55E00", linewidths=1.6,
    )  # fmt: skip
    # left is positive, as on the road
    axes.invert_xaxis()
    axes.set(xlabel="azimuth, left positive [deg]", ylabel="range [m]", title=f"{name}, frame 0: strongest returns")
    with whole(out_path) as part, part.open("wb") as file:
        figure.savefig(file, format="png", dpi=110, metadata={"Software": None})
