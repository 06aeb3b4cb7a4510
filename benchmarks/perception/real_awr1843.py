"""A person as a track over a real 77 GHz capture: 20 s of an AWR1843 indoors, 1000 frames of one loop, 20 ms apart.

The capture lacks two of four lanes (`contrib.boards.dca1000_capture`): the evidence for that reading is among the
figures.
What stands still is the mean over a second about a frame, and is taken off; the strongest return left, 15 dB or more
over the noise, is measured between cells in range and azimuth. The tracker in use follows it, told what is different
here: a person in plain sight, measured 50 times a second, not the middle of a vehicle behind a corner every 0.3 s.
A single loop shows no Doppler, so that the transmitters' slots are turned back by the track's own closing speed.
The row's channels are not calibrated: their phases off a straight front are the median over the capture's own returns,
which says nothing about the row's axis.

- Gap: frames between the first and the last of a track at which no confirmed track stands.
- Raw profile: the strongest moving range bin of a frame, over all channels, without the row, the tracker or its time.
- Receivers agree: phase steps from receiver to receiver in one chirp less those in the next, 90 % quantile. They are
  of one direction, whichever transmitter sends. `as_500_frames` is the same for frames of twice as many bytes.
Usage: python -m benchmarks.perception.real_awr1843 [--data DIR] [--json]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks.captures import add_data_option, capture_folder
from contrib.boards.config_file import read_config
from contrib.boards.dca1000_capture import Dca1000Config, array_params, frame_samples, map_grid
from contrib.boards.digital_array import DigitalArrayParams, form_digital_map, slots_turned
from models.perception.track.odometry import stationary_pose
from models.perception.track.tracker import Tracker, TrackerParams
from msgs.values.perception import BevFrame, BevGrid, HiddenObject, Track
from msgs.values.units import ns_from_s

CAPTURE, SCRIPT = "task3_gt_Raw_0.bin", "1843_config_debug_task3.lua"
FOLDER = "awr1843_com405_task3"
#: Frames of the mean that stands for what does not move: a second.
STATIC_FRAMES = 51
#: The transmitters' leakage lies nearer.
LEAST_RANGE_M = 0.3
LEAST_SNR_DB = 15.0
#: A person is half a metre wide, and another part of the body is the strongest from frame to frame; at 50 frames a
#: second they agree for several frames. Steps turn within half a second.
TRACKER = TrackerParams(
    acceleration_density_m2ps3=2.0, first_speed_std_mps=1.5, place_std_m=0.15, detection_probability=0.9
)
SCORE = 0.5


@dataclass(frozen=True)
class Capture:
    """Samples of all frames, complex64 [frames, channels, samples], and what they were taken with."""

    samples: np.ndarray
    config: Dca1000Config
    array: DigitalArrayParams

    @property
    def period_s(self) -> float:
        """Time from frame to frame."""
        return 1e-3 * self.config.frame.period_ms


@dataclass(frozen=True)
class Moving:
    """The moving return of a frame."""

    range_m: float
    azimuth_rad: float
    snr_db: float


def read_capture(folder: Path) -> Capture:
    """The capture of a folder, by its own script."""
    return with_config(folder, read_config(folder / SCRIPT, None))


def with_config(folder: Path, config: Dca1000Config) -> Capture:
    """The capture of a folder, read as a configuration says."""
    frames = np.fromfile(folder / CAPTURE, "<i2").reshape(-1, config.frame_bytes // 2)
    samples = np.stack([frame_samples(frame, config)[0] for frame in frames])
    return Capture(samples, config, array_params(config))


def without_static(samples: np.ndarray) -> np.ndarray:
    """Samples less their mean over a second about each frame."""
    sums = np.cumsum(samples, axis=0, dtype=np.complex128)
    sums = np.concatenate([np.zeros_like(sums[:1]), sums])
    frame = np.arange(len(samples))
    first, end = np.maximum(frame - STATIC_FRAMES // 2, 0), np.minimum(frame + STATIC_FRAMES // 2 + 1, len(samples))
    mean = (sums[end] - sums[first]) / (end - first)[:, None, None]
    return (samples - mean).astype(np.complex64)


def straightened(samples: np.ndarray, capture: Capture) -> np.ndarray:
    """Samples [frames, channels, samples] less each channel's phase off a straight front, that of the first at 0.

    The front of a frame is straight through the steps within each transmitter's receivers; what its strongest bin
    deviates, the median over frames is the channel's own.
    """
    peaks = strongest_bins(samples, capture)
    steps = np.angle(peaks[:, 1:] * peaks[:, :-1].conj())
    within = np.array([first == second for first, second in pairwise(capture.array.channel_slot)])
    mean = np.angle(np.exp(1j * steps[:, within]).mean(axis=1))
    own = np.angle(np.exp(1j * (steps - mean[:, None])))
    phases = np.concatenate([[0.0], np.cumsum(np.median(own, axis=0))])
    return np.asarray(samples * np.exp(-1j * phases).astype(np.complex64)[:, None])


def strongest_bins(samples: np.ndarray, capture: Capture) -> np.ndarray:
    """The strongest range bin of each frame beyond the leakage, complex [frames, channels]."""
    spectra = np.fft.fft(samples * np.hanning(samples.shape[-1]))
    spectra[..., : int(np.ceil(LEAST_RANGE_M / capture.array.range_bin_m(samples.shape[-1])))] = 0.0
    strongest = np.sum(np.abs(spectra) ** 2, axis=1).argmax(axis=1)
    return np.asarray(np.take_along_axis(spectra, strongest[:, None, None], axis=2)[..., 0])


def receivers_agree_deg(capture: Capture) -> float:
    """How far the receivers' phase steps in one chirp are from those in the other; 90 % quantile over frames."""
    peaks = strongest_bins(without_static(capture.samples), capture).reshape(len(capture.samples), -1, 4)
    steps = peaks[..., 1:] * peaks[..., :-1].conj()
    return float(np.degrees(np.quantile(np.abs(np.angle(steps[:, 1] * steps[:, 0].conj())), 0.9)))


def moving_return(samples: np.ndarray, capture: Capture, closing_speed_mps: float) -> Moving | None:
    """The strongest return of a frame [channels, samples], measured between cells; None where all is noise."""
    turned = slots_turned(samples[None], capture.array, closing_speed_mps)
    ra_map = form_digital_map(turned, capture.array, map_grid(capture.config)).map
    grid = ra_map.grid
    level_db = 10.0 * np.log10(np.maximum(np.abs(ra_map.values) ** 2, 1e-30) / max(ra_map.noise_power_mw, 1e-30))
    level_db[grid.range_m < LEAST_RANGE_M] = -np.inf
    row, column = (int(at) for at in np.unravel_index(level_db.argmax(), grid.shape))
    if level_db[row, column] < LEAST_SNR_DB:
        return None
    return Moving(
        range_m=float(grid.range_at(row + _vertex(level_db[:, column], row))),
        azimuth_rad=float(grid.azimuth_at(column + _vertex(level_db[row], column))),
        snr_db=float(level_db[row, column]),
    )


def _vertex(level_db: np.ndarray, at: int) -> float:
    """Offset of the vertex of the parabola through a maximum and its neighbours; 0 at an edge."""
    if not 0 < at < len(level_db) - 1 or not np.isfinite(level_db[at - 1 : at + 2]).all():
        return 0.0
    left, peak, right = level_db[at - 1 : at + 2]
    return 0.0 if left + right >= 2.0 * peak else float(0.5 * (left - right) / (left - 2.0 * peak + right))


def as_view(moving: Moving | None, capture: Capture, frame: int) -> BevFrame:
    """A scan whose one object, if any, is the moving return."""
    objects = ()
    if moving is not None:
        c, s = np.cos(moving.azimuth_rad), np.sin(moving.azimuth_rad)
        # eight half-wavelength columns: a beam of 13 deg over the root of twice the SNR
        across_m = moving.range_m * 0.22 / np.sqrt(2.0 * 10.0 ** (0.1 * moving.snr_db))
        along_m = 0.5 * capture.array.range_bin_m(capture.samples.shape[-1])
        turn = np.array([[c, -s], [s, c]])
        (xx, xy), (_, yy) = (turn @ np.diag([along_m**2, across_m**2]) @ turn.T).tolist()
        place = HiddenObject(
            id=0, x_m=float(moving.range_m * c), y_m=float(moving.range_m * s), length_m=0.5, width_m=0.5, yaw_rad=0.0,
            score=SCORE, cov_m2=((xx, xy), (xy, yy)),
        )  # fmt: skip
        objects = (place,)
    grid = BevGrid()
    return BevFrame(
        stamp_ns=1_000_000_000 + ns_from_s(frame * capture.period_s),
        scan_id=frame,
        objects=objects,
        los_points_m=np.zeros((0, 2), np.float32),
        grid=grid,
        visibility=np.zeros((grid.rows, grid.columns), np.uint8),
    )


def closing_speed_mps(track: Track) -> float:
    """How fast a track comes nearer."""
    return -(track.x_m * track.velocity_x_mps + track.y_m * track.velocity_y_mps) / max(
        np.hypot(track.x_m, track.y_m), 1e-6
    )


def follow(capture: Capture) -> tuple[list[Moving | None], list[Track | None]]:
    """The moving return and the oldest confirmed track of each frame."""
    tracker, pose = Tracker(TRACKER), stationary_pose()
    moving, tracks, speed_mps = [], [], 0.0
    for frame, samples in enumerate(straightened(without_static(capture.samples), capture)):
        moving.append(moving_return(samples, capture, speed_mps))
        confirmed = tracker.step(as_view(moving[-1], capture, frame), pose)
        tracks.append(max(confirmed, key=lambda track: track.age_s, default=None))
        speed_mps = 0.0 if tracks[-1] is None else closing_speed_mps(tracks[-1])
    return moving, tracks


def measure(folder: Path) -> dict[str, Any]:
    """Figures of the track, and its course, of the capture in a folder."""
    capture = read_capture(folder)
    other = with_config(folder, msgspec.structs.replace(capture.config, sent_lanes=None))
    moving, tracks = follow(capture)
    spectra = np.fft.fft((capture.samples - capture.samples.mean(axis=0)) * np.hanning(capture.samples.shape[-1]))
    power = np.sum(np.abs(spectra) ** 2, axis=1)
    range_m = capture.array.range_bin_m(power.shape[1]) * np.arange(power.shape[1])
    power[:, range_m < LEAST_RANGE_M] = 0.0
    raw_m = np.asarray(range_m[power.argmax(axis=1)])
    track_m, azimuth_rad, speeds = (np.full(len(tracks), np.nan) for _ in range(3))
    for at, track in enumerate(tracks):
        if track is not None:
            track_m[at], azimuth_rad[at] = np.hypot(track.x_m, track.y_m), np.arctan2(track.y_m, track.x_m)
            speeds[at] = closing_speed_mps(track)
    held = np.flatnonzero(np.isfinite(track_m))
    ids = [track.id for track in tracks if track is not None]
    error_m = np.abs(track_m - raw_m)[held]
    slot_s = capture.array.chirp_interval_s * np.ptp(capture.array.channel_slot)
    return {
        "frames": len(tracks),
        "seconds": len(tracks) * capture.period_s,
        "receivers_agree_deg": {
            "as_1000_frames": receivers_agree_deg(capture),
            "as_500_frames": receivers_agree_deg(other),
        },
        "frames_with_return": sum(each is not None for each in moving),
        "tracks": len(set(ids)),
        "longest_track_s": max(map(ids.count, set(ids)), default=0) * capture.period_s,
        "first_frame": int(held[0]),
        "gap_frames": int(held[-1] - held[0] + 1 - len(held)),
        "track_less_raw_m": {
            "median": float(np.median(error_m)),
            "p95": float(np.quantile(error_m, 0.95)),
            "max": float(error_m.max()),
        },
        "fastest_closing_mps": float(np.nanmax(speeds)),
        "fastest_opening_mps": float(-np.nanmin(speeds)),
        "largest_slot_turn_deg": float(
            np.degrees(4.0 * np.pi / capture.array.wavelength_m * slot_s * np.nanmax(np.abs(speeds)))
        ),
        "course": [
            {
                "t_s": at * capture.period_s,
                "raw_m": float(raw_m[at]),
                "track_m": float(track_m[at]),
                "azimuth_deg": float(np.degrees(azimuth_rad[at])),
                "closing_mps": float(speeds[at]),
            }
            for at in held
        ],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_data_option(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    arguments = parser.parse_args()
    result = measure(capture_folder(parser, arguments.data, FOLDER))
    course = result.pop("course")
    if arguments.json:
        print(json.dumps(result))
        return
    print(json.dumps(result, indent=1))
    for each in course[:: max(len(course) // 20, 1)]:
        print("  ".join(f"{name} {value:7.2f}" for name, value in each.items()))


if __name__ == "__main__":
    main()
