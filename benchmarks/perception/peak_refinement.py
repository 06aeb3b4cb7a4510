"""Sub-cell refinement against its Cramer-Rao bound: RMSE of range and azimuth over SNR, array errors, two points.

SNR is that of `Peaks`: power of an ideal beam steered at the echo, on its bin, over the noise of a map's cell. Echoes
lie at random fractions of a cell within +-50 degrees; the array is the default one with its phases as set. Both ways
start from the strongest cell within two bins and five azimuth cells of the echo, as a detector would hand it over.
`model errors`: every column's gain and phase off by 0.4 dB and 0.05 rad (standard deviations) unknown to the map.
`two points`: equal echoes, random phases, same range; both ways start within 0.5 bins and 5 cells (0.4 of the distance
for near ones) of the truth, which is knowledge the bound does not have: where it is wider than that, errors lie below
it. Medians are shown there, for the bound of a pair has no mean to speak of when the phases agree.
`--data DIR` holds the ways of `NetworkDetector` against the validation frames of a data set: peaks against the
truth points matched to them (one to one, same class, 2 m), dense and recovered F1 within 0.5, 1 and 2 m, and what
likelihood adds to the ridge with the standard deviation of that over 500 redraws of the frames.
Run from the root of the checkout:
OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python -m benchmarks.perception.peak_refinement [--trials 400] [--seed 0]
[--json]
                                                                [--picture FILE.png] [--data data/places_v1]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from dataclasses import astuple
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import scipy
from rich.console import Console
from rich.progress import track

from benchmarks.perception.cramer_rao import azimuth_response, periodogram_range_loss, raw_bound, windowed_bound
from mirrorwave.plots.style import legend_below, new_figure, save
from models.evaluation.metrics import dense_counts, match_points, recovered_counts
from models.perception.detection.detectors import NetworkDetector, Refine
from models.perception.detection.peaks import PeakParams, peaks_at
from models.perception.detection.refinement import EchoRefiner, RefinementParams
from models.perception.detection.ridges import lobe_azimuth
from models.perception.forming.coarray import AzimuthInterpolator
from models.perception.forming.ra_forming import ScanProfiles, form_map
from models.perception.geometry.stage import GeometryParams, fold_scan
from models.physics.antenna import setup_weights
from models.physics.waveform import WINDOW_TAPS, tone_profile, window_noise_gain
from models.training.data.frames import DataSet, Frame, fixed_splits
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass, Peaks
from msgs.values.radar import RadarSetup, RangeAzimuthGrid, RangeAzimuthMap

SETUP = RadarSetup()
GRID = RangeAzimuthGrid()
INTERPOLATOR = AzimuthInterpolator(SETUP)
#: The bound of the estimator alone: no floor for what a real scene adds.
REFINER = EchoRefiner(SETUP, RefinementParams(range_std_floor_m=0.0, azimuth_std_floor_deg=0.0))
SNR_DB = tuple(range(10, 41, 5))
SEPARATIONS = (4, 8, 16)
GAIN_STD_DB, PHASE_STD_RAD = 0.4, 0.05
#: Range bins between echoes of one map: far enough not to see each other.
SPACING_BINS = 24
#: Progress goes beside the report, not into it.
PROGRESS = Console(stderr=True)
#: Distances within which a point is found, and the scores for them.
GATES_M = (0.5, 1.0, 2.0)
SCORES = tuple(f"{kind}_f1_{gate_m:g}m" for kind in ("dense", "recovered") for gate_m in GATES_M)
#: Median size of a normal error of unit standard deviation.
NORMAL_MEDIAN = 0.67449
#: Metres and degrees of a cell.
UNIT = np.array([GRID.range_bin_m, np.degrees(GRID.azimuth_step_rad)])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--trials", type=int, default=400, help="echoes (or pairs) at each SNR")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture", type=Path, help="figure to write")
    parser.add_argument("--data", type=Path, help="data set whose validation frames are measured too")
    options = parser.parse_args()
    report = measure(options.trials, options.seed)
    if options.data:
        report["validation"] = measure_frames(options.data, options.seed)
    if options.picture:
        draw(report, options.picture)
    print(json.dumps(report) if options.json else as_text(report))


def measure(trials: int, seed: int) -> dict[str, Any]:
    """Everything, as JSON."""
    return {
        "seed": seed,
        "trials": trials,
        "machine": machine(),
        "periodogram_range_loss": periodogram_range_loss(),
        "one_point": [point_row(snr_db, trials, seed, False) for snr_db in SNR_DB],
        "model_errors": [point_row(snr_db, trials, seed, True) for snr_db in SNR_DB],
        "two_points": [pair_row(cells, snr_db, trials, seed) for cells in SEPARATIONS for snr_db in SNR_DB],
        "milliseconds_50_peaks": time_refinement(seed),
    }


def machine() -> dict[str, str | int | None]:
    """What the figures were measured on."""
    return {
        "system": platform.system(),
        "architecture": platform.machine(),
        "cores": os.cpu_count(),
        "threads": os.environ.get("OMP_NUM_THREADS"),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }


def random_echoes(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fractional range bins, azimuths [rad] and phases [rad] of echoes that do not see each other."""
    range_bin = SPACING_BINS * (1.0 + np.arange(count)) + rng.uniform(-0.5, 0.5, count)
    return range_bin, np.radians(rng.uniform(-50.0, 50.0, count)), rng.uniform(0.0, 2.0 * np.pi, count)


def noisy_map(
    rng: np.random.Generator,
    range_bin: np.ndarray,
    azimuth_rad: np.ndarray,
    phase_rad: np.ndarray,
    snr_db: float,
    setup: RadarSetup = SETUP,
) -> RangeAzimuthMap:
    """The map of unit echoes at an SNR of its cells, measured with the weights of `setup`, formed with the nominal."""
    noise_mw = beam_noise_mw(snr_db)
    tones = tone_profile(SETUP.radar.samples_per_chirp, range_bin, GRID.range_bins) * np.exp(1j * phase_rad)[:, None]
    shape = (len(SETUP.beams), GRID.range_bins + 2)
    white = rng.standard_normal((2, *shape)) * np.sqrt(0.5 * noise_mw / window_noise_gain("hann"))
    bins = white[0] + 1j * white[1]
    noise = sum(tap * bins[:, i : i + GRID.range_bins] for i, tap in enumerate(WINDOW_TAPS["hann"]))
    profiles = azimuth_response(setup, azimuth_rad).T @ tones + noise
    stamps_ns = np.zeros(len(SETUP.beams), np.int64)
    return form_map(ScanProfiles(0, 0, profiles.astype(np.complex64), noise_mw, stamps_ns), INTERPOLATOR)


def beam_noise_mw(snr_db: float) -> float:
    """A beam's noise under which a unit echo has `snr_db` over a cell's."""
    return 10.0 ** (-snr_db / 10.0) / INTERPOLATOR.noise_gain()


def strange_setup(rng: np.random.Generator) -> RadarSetup:
    """The set-up with gain and phase errors of its columns, which the receiver does not know."""
    columns = SETUP.array.columns
    gain = 10.0 ** (GAIN_STD_DB * rng.standard_normal(columns) / 20.0)
    error = gain * np.exp(1j * PHASE_STD_RAD * rng.standard_normal(columns))
    return msgspec.structs.replace(SETUP, steering_weights=(setup_weights(SETUP) * error).astype(np.complex64))


def starts(ra_map: RangeAzimuthMap, range_bin: np.ndarray, azimuth_rad: np.ndarray) -> np.ndarray:
    """The strongest cell near each echo, [N, 2]."""
    power = np.abs(ra_map.values) ** 2
    middle = np.rint(np.stack([range_bin, GRID.azimuth_index(azimuth_rad)], axis=1)).astype(int)
    cells = []
    for i, j in middle:
        low = np.maximum((i - 2, j - 5), 0)
        window = power[low[0] : i + 3, low[1] : j + 6]
        cells.append(low + np.unravel_index(window.argmax(), window.shape))
    return np.array(cells)


def both_ways(ra_map: RangeAzimuthMap, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fractional places [N, 2] by parabolas over the level (the ridge) and by likelihood."""
    level_db = 10.0 * np.log10(np.maximum(np.abs(ra_map.values) ** 2, 1e-30))
    fractional = np.stack([cells[:, 0].astype(float), lobe_azimuth(level_db, cells)], axis=1)
    ones = np.ones(len(cells))
    peaks = peaks_at(ra_map, cells, fractional, ones, ones.astype(np.uint8), PeakParams())
    ridge = np.stack([GRID.range_index(peaks.range_m), GRID.azimuth_index(peaks.azimuth_rad)], axis=1)
    return ridge, REFINER.refine(ra_map, ridge).fractional


def point_row(snr_db: int, trials: int, seed: int, model_errors: bool) -> dict[str, Any]:
    """RMSE [m, deg] of both ways on isolated echoes, and the bounds, averaged over the same places."""
    rng = np.random.default_rng([seed, snr_db])
    # few echoes share an array, so that its errors average too
    per_map = 4 if model_errors else GRID.range_bins // SPACING_BINS - 1
    errors, bounds = [], []
    for first in range(0, trials, per_map):
        range_bin, azimuth_rad, phase_rad = random_echoes(rng, min(per_map, trials - first))
        setup = strange_setup(rng) if model_errors else SETUP
        ra_map = noisy_map(rng, range_bin, azimuth_rad, phase_rad, snr_db, setup)
        ways = both_ways(ra_map, starts(ra_map, range_bin, azimuth_rad))
        truth = np.stack([range_bin, GRID.azimuth_index(azimuth_rad)], axis=1)
        errors.append([(way - truth) * UNIT for way in ways])
        bounds += [point_bounds(*place, beam_noise_mw(snr_db)) for place in zip(range_bin, azimuth_rad, strict=True)]
    return as_row({"snr_db": snr_db}, errors, bounds)


def point_bounds(range_bin: float, azimuth_rad: float, noise_mw: float) -> list[np.ndarray]:
    """Variances (range [m^2], azimuth [deg^2]) of one unit echo: raw samples, and five windowed bins."""
    echo = (SETUP, np.array([range_bin]), np.array([azimuth_rad]), np.ones(1), noise_mw)
    bins = round(range_bin) + np.arange(-2, 3)
    covariances = (raw_bound(*echo)[0], windowed_bound(*echo, bins=bins)[0])
    return [np.diag(covariance) * (1.0, np.degrees(1.0) ** 2) for covariance in covariances]


def pair_row(cells: int, snr_db: int, trials: int, seed: int) -> dict[str, Any]:
    """The same for two equal echoes so many azimuth cells apart in one range bin, their phases random."""
    rng = np.random.default_rng([seed, snr_db, cells])
    per_map = GRID.range_bins // SPACING_BINS - 1
    errors, bounds = [], []
    noise_mw = beam_noise_mw(snr_db)
    for first in range(0, trials, per_map):
        range_bin, azimuth_rad, phase_rad = random_echoes(rng, min(per_map, trials - first))
        apart_rad = cells * GRID.azimuth_step_rad
        place = np.repeat(range_bin, 2)
        azimuth_rad = (azimuth_rad[:, None] + np.array([-0.5, 0.5]) * apart_rad).ravel()
        phase_rad = np.stack([phase_rad, rng.uniform(0.0, 2.0 * np.pi, len(phase_rad))], axis=1).ravel()
        ra_map = noisy_map(rng, place, azimuth_rad, phase_rad, snr_db)
        truth = np.stack([place, GRID.azimuth_index(azimuth_rad)], axis=1)
        # a start each, as a network would name them: a quarter of a beam or half a bin wrong at most
        start = truth + rng.uniform(-1.0, 1.0, truth.shape) * np.minimum((0.5, 5.0), (0.5, 0.4 * cells))
        named = np.clip(np.rint(start).astype(int), 0, np.array(GRID.shape) - 1)
        ridge, _ = both_ways(ra_map, named)
        errors.append([(way - truth) * UNIT for way in (ridge, REFINER.refine(ra_map, start).fractional)])
        for pair in range(0, len(place), 2):
            both = slice(pair, pair + 2)
            bound = raw_bound(SETUP, place[both], azimuth_rad[both], np.exp(1j * phase_rad[both]), noise_mw)
            bounds += [[np.diag(one) * (1.0, np.degrees(1.0) ** 2)] * 2 for one in bound]
    return as_row({"cells": cells, "snr_db": snr_db}, errors, bounds)


def as_row(row: dict[str, Any], errors: list[Any], bounds: list[Any]) -> dict[str, Any]:
    """Root mean squares and medians of errors, root means of bounds."""
    ridge, likelihood = (np.concatenate([error[way] for error in errors]) for way in (0, 1))
    raw, windowed = np.sqrt(np.mean(bounds, axis=0))
    named = {"ridge": ridge, "likelihood": likelihood}
    for way, error in named.items():
        row[f"{way}_range_m"], row[f"{way}_azimuth_deg"] = map(float, np.sqrt(np.mean(error**2, axis=0)))
        row[f"{way}_median_range_m"], row[f"{way}_median_azimuth_deg"] = map(float, np.median(np.abs(error), axis=0))
    row["bound_range_m"], row["bound_azimuth_deg"] = map(float, raw)
    medians = NORMAL_MEDIAN * np.median(np.sqrt(np.array(bounds)[:, 0]), axis=0)
    row["bound_median_range_m"], row["bound_median_azimuth_deg"] = map(float, medians)
    row["windowed_bound_range_m"] = float(windowed[0])
    return row


def time_refinement(seed: int, peaks: int = 50, rounds: int = 15) -> float:
    """Median time [ms] to refine the echoes of one map, random over it, in one thread if the caller allows but one."""
    rng = np.random.default_rng([seed, peaks])
    range_bin, azimuth_rad = rng.uniform(10.0, 500.0, peaks), np.radians(rng.uniform(-50.0, 50.0, peaks))
    ra_map = noisy_map(rng, range_bin, azimuth_rad, rng.uniform(0.0, 2.0 * np.pi, peaks), 30.0)
    start = np.stack([range_bin, GRID.azimuth_index(azimuth_rad)], axis=1)
    durations = []
    for _ in range(rounds):
        begin = time.perf_counter()
        REFINER.refine(ra_map, start)
        durations.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(durations))


def measure_frames(directory: Path, seed: int) -> dict[str, Any]:
    """Each way to refine on the validation frames of a data set."""
    data = DataSet(directory)
    frames = fixed_splits(directory).validation
    results, counts = {}, {}
    for way in Refine:
        detector = NetworkDetector(SETUP, refine=way)
        rows = [
            frame_row(frame, detector.detect(frame.ra_map))
            for frame in track(data.frames(frames), way, len(frames), console=PROGRESS)
        ]
        counts[way] = np.array([row for row, _ in rows])
        errors = np.abs(np.concatenate([error for _, error in rows]))
        results[way] = {
            "matched": len(errors),
            "median_range_m": float(np.median(errors[:, 0])),
            "median_azimuth_deg": float(np.median(errors[:, 1])),
            **dict(zip(SCORES, map(float, f1_scores(counts[way])), strict=True)),
        }
    rng = np.random.default_rng(seed)
    draws = rng.integers(len(frames), size=(500, len(frames)))
    gains = [f1_scores(counts["likelihood"][draw]) - f1_scores(counts["ridge"][draw]) for draw in draws]
    results["gain_std"] = dict(zip(SCORES, map(float, np.std(gains, axis=0)), strict=True))
    return {"frames": len(frames), **results}


def frame_row(frame: Frame, peaks: Peaks) -> tuple[list[list[int]], np.ndarray]:
    """Counts (true and false positives, false negatives) for each score, and errors (m, deg) of matched peaks."""
    labels = frame.labels
    found_m, truth_m = (
        xy_from_polar(of.range_m.astype(np.float64), of.azimuth_rad.astype(np.float64)) for of in (peaks, labels)
    )
    counts = []
    for gate_m in GATES_M:
        dense = dense_counts(found_m, peaks.path_class, truth_m, labels.path_class, gate_m)
        counts += [dense[path_class] for path_class in PathClass]
    points_m = fold_scan(peaks, GeometryParams()).recovered.points_m
    hidden_m = labels.hidden_xy_m[labels.path_class == PathClass.MIRRORED].astype(np.float64)
    counts += [recovered_counts(points_m.reshape(-1, 2), hidden_m, gate_m) for gate_m in GATES_M]
    errors = []
    for path_class in PathClass:
        ours, theirs = (np.flatnonzero(of.path_class == path_class) for of in (peaks, labels))
        i, j = match_points(found_m[ours], truth_m[theirs], max(GATES_M)).T
        i, j = ours[i], theirs[j]
        azimuth_deg = np.degrees(peaks.azimuth_rad[i] - labels.azimuth_rad[j])
        errors.append(np.stack([peaks.range_m[i] - labels.range_m[j], azimuth_deg], axis=1))
    return [list(astuple(count)) for count in counts], np.concatenate(errors)


def f1_scores(counts: np.ndarray) -> np.ndarray:
    """`SCORES` of the counts [frames, 3 x classes + 3, 3] of some frames."""
    right, wrong, missed = counts.sum(axis=0).T
    f1 = 2.0 * right / np.maximum(2.0 * right + wrong + missed, 1)
    dense = f1[: -len(GATES_M)].reshape(len(GATES_M), -1).mean(axis=1)
    return np.concatenate([dense, f1[-len(GATES_M) :]])


def as_text(report: dict[str, Any]) -> str:
    """Tables to read."""
    lines = [f"seed {report['seed']}, {report['trials']} trials a row, {json.dumps(report['machine'])}"]
    lines.append(f"window: a Hann periodogram's peak has {report['periodogram_range_loss']:.3f} x the raw range bound")
    head = f"{'SNR':>5} {'ridge':>10} {'likelihood':>10} {'bound':>10} {'ratio':>6}"
    for title, measure in (("one_point", "RMSE"), ("model_errors", "RMSE"), ("two_points", "median")):
        median = "median_" if measure == "median" else ""
        for quantity, unit in (("range", "m"), ("azimuth", "deg")):
            lines += ["", f"{title}: {quantity} {measure} [{unit}]", head]
            lines += [_text_row(row, f"{median}{quantity}_{unit}") for row in report[title]]
    lines += ["", f"{report['milliseconds_50_peaks']:.1f} ms a map with 50 peaks"]
    for way, scores in report.get("validation", {}).items():
        text = scores if way == "frames" else ", ".join(f"{name} {value:.4g}" for name, value in scores.items())
        lines.append(f"{way}: {text}")
    return "\n".join(lines)


def _text_row(row: dict[str, Any], key: str) -> str:
    ridge, likelihood, bound = (row[f"{way}_{key}"] for way in ("ridge", "likelihood", "bound"))
    apart = f"  {row['cells']} cells apart" if "cells" in row else ""
    return f"{row['snr_db']:5d} {ridge:10.5f} {likelihood:10.5f} {bound:10.5f} {likelihood / bound:6.2f}{apart}"


def draw(report: dict[str, Any], path: Path) -> None:
    """Four panels: range, azimuth, array errors, two points; signs below each."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure = new_figure(10.0, 10.0)
    axes = figure.subplots(2, 2)
    figure.suptitle("Peak refinement on the complex map against the Cramer-Rao bound", fontsize=12)
    one, errors = report["one_point"], report["model_errors"]
    _panel(axes[0, 0], one, "range_m", 1e3, "Range RMSE [mm]", "One echo: range")
    _panel(axes[0, 1], one, "azimuth_deg", 1.0, "Azimuth RMSE [deg]", "One echo: azimuth")
    title = f"Unknown column errors {GAIN_STD_DB} dB, {PHASE_STD_RAD} rad: azimuth"
    _panel(axes[1, 0], errors, "azimuth_deg", 1.0, "Azimuth RMSE [deg]", title)
    floor = errors[-1]["likelihood_azimuth_deg"]
    note = f"floor {floor:.2f} deg:\nthe array's errors"
    axes[1, 0].annotate(note, (SNR_DB[-1], floor), (-6, 30), textcoords="offset points", ha="right", fontsize=9)
    _pair_panel(axes[1, 1], report["two_points"])
    for axis in axes.flat:
        axis.set_yscale("log")
        axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.grid(True, which="major", color="0.92")
        axis.set_axisbelow(True)
        axis.set_xlim(SNR_DB[0], SNR_DB[-1])
        axis.spines[["top", "right"]].set_visible(False)
        axis.set_xlabel("SNR of the map's cell [dB]")
        legend_below(axis, columns=2)
    save(figure, path)


def _panel(axis: Any, rows: list[dict[str, Any]], key: str, scale: float, label: str, title: str) -> None:
    snr_db = [row["snr_db"] for row in rows]
    bound = scale * np.array([row[f"bound_{key}"] for row in rows])
    axis.fill_between(snr_db, bound, 2.0 * bound, color="tab:green", alpha=0.12, label="within 2 x the bound")
    axis.plot(snr_db, bound, color="black", lw=1.5, label="bound, raw samples")
    if key == "range_m":
        windowed = scale * np.array([row["windowed_bound_range_m"] for row in rows])
        axis.plot(snr_db, windowed, color="black", lw=1.2, ls="--", label="bound, 5 bins after the Hann window")
    for way, name, colour, marker in (
        ("ridge", "parabola on the ridge", "tab:orange", "s"),
        ("likelihood", "likelihood", "tab:blue", "o"),
    ):
        values = scale * np.array([row[f"{way}_{key}"] for row in rows])
        axis.plot(snr_db, values, color=colour, marker=marker, ms=5, lw=1.8, label=name)
    axis.set_title(title, fontsize=11)
    axis.set_ylabel(label)


def _pair_panel(axis: Any, rows: list[dict[str, Any]]) -> None:
    for cells, colour in zip(SEPARATIONS, ("tab:red", "tab:purple", "tab:blue"), strict=True):
        own = [row for row in rows if row["cells"] == cells]
        snr_db = [row["snr_db"] for row in own]
        degrees = cells * np.degrees(GRID.azimuth_step_rad)
        name = f"{degrees:.1f} deg apart ({cells} cells)"
        for way, style in (
            ("likelihood", {"marker": "o", "ms": 5, "label": name}),
            ("bound", {"lw": 1.2, "ls": "--"}),
            ("ridge", {"lw": 1.0, "ls": ":", "alpha": 0.8}),
        ):
            axis.plot(snr_db, [row[f"{way}_median_azimuth_deg"] for row in own], color=colour, **style)
    axis.plot([], [], color="0.3", marker="o", ms=5, label="likelihood")
    axis.plot([], [], color="0.3", ls="--", label="bound of the pair")
    axis.plot([], [], color="0.3", ls=":", label="parabola on the ridge")
    axis.set_title("Two equal echoes at one range: azimuth", fontsize=11)
    axis.set_ylabel("Median azimuth error [deg]")


if __name__ == "__main__":
    main()
