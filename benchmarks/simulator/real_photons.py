"""Real photons of hidden objects against the photon model: distance, response, fall-off, and the shape of histograms.

Confocal transients of two scenes (not part of the project; tests/captures.py says where they lie). For each: the
hidden plane by the light-cone transform; pulse, tail and fall-off by maximum likelihood from 64 wall points, each with
a gain of its own; then the histograms of 64 other wall points by `expected_histogram`, with the fitted reflectances.
Models differ in the detector's tail (without it the pulse is the most likely of `PULSES_S`) and in the law of the
hidden surface. Statistics of each wall point: chi-square per cell of 16 ps, and the largest distance between cumulative
shapes (Kolmogorov-Smirnov); "null" has them of histograms drawn by `draw_histogram` from the last model. Level: hidden
counts over the wall's own, as measured and at most for a matt plane of reflectance 1 under a spot of 1 cm radius.
Usage: OPENBLAS_NUM_THREADS=1 python -m benchmarks.simulator.real_photons --data DIR [--seed 0] [--json] [--out DIR]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from benchmarks.captures import add_data_option, capture_folder
from benchmarks.simulator.photon_target import (
    BINS_PER_CELL,
    Loss,
    Observed,
    Plane,
    Response,
    TargetFit,
    Window,
    fit_at,
    fit_response,
    fitted_gain,
    matt_share,
    plane_patches,
    retroreflected_share,
)
from lab.transients.confocal import read_confocal
from lab.transients.import_transients import draw_shape
from lab.transients.light_cone import DEFAULT_SNR, reconstruct
from lab.transients.scan import ConfocalTransients
from lab.transients.shape import HiddenShape, hidden_shape
from models.physics.photons.counting import draw_histogram, expected_histogram
from msgs.values.lidar import SpadParams
from msgs.values.units import SPEED_OF_LIGHT_MPS

FIRST_BIN = 600
#: Standard deviations of a pulse without a tail.
PULSES_S = (30e-12, 60e-12, 100e-12, 150e-12)
EXPONENTS = (0.0, 1.0, 2.0, 4.0, 6.0, 8.0)
SPOT_RADIUS_M = 0.01


class Scene(NamedTuple):
    """A file, where its object returns, and the patches along a side of the plane."""

    file: str
    window: Window
    side: int
    #: Where the search starts, the depth apart.
    start: Response


SCENES = {
    "dot chart": Scene(
        "data_dot_chart_40cm.mat", Window(620, 1100, 1500, 2048), 48, Response(28e-12, 0.43, 250e-12, 2.5, 0.0)
    ),
    "exit sign": Scene(
        "data_exit_sign.mat", Window(1240, 2040, 1000, 1240), 48, Response(28e-12, 0.43, 250e-12, 6.0, 0.0)
    ),
}


class Fitted(NamedTuple):
    """A model of a scene: response, law, and the reflectances that fit under them."""

    response: Response
    loss: Loss
    fit: TargetFit


def wall_points(scan: ConfocalTransients, start: int) -> tuple[np.ndarray, np.ndarray]:
    """Every eighth row and column."""
    every = np.arange(start, len(scan.counts), 8)
    rows, columns = np.meshgrid(every, every, indexing="ij")
    return rows.ravel(), columns.ravel()


def models_of(
    scan: ConfocalTransients, scene: Scene, plane: Plane, observed: Observed, fitted: tuple[Response, TargetFit]
) -> dict[str, Fitted]:
    """The model as fitted, without its tail, with a matt surface, and with neither."""
    response = fitted[0]
    laws: dict[str, Loss] = {"matt": matt_share, "retroreflective": retroreflected_share}
    models = {}
    for name, loss in laws.items():
        tries = [replace(response, rms_s=rms_s, tail_share=0.0) for rms_s in PULSES_S]
        fits = [fit_at(scan, scene.window, plane, observed, one, loss) for one in tries]
        best = int(np.argmin([one.deviance for one in fits]))
        models[f"Gaussian, {name}"] = Fitted(tries[best], loss, fits[best])
    models["tail, matt"] = Fitted(
        response, matt_share, fit_at(scan, scene.window, plane, observed, response, matt_share)
    )
    models["tail, retroreflective"] = Fitted(response, retroreflected_share, fitted[1])
    return models


def simulated(
    scan: ConfocalTransients, window: Window, plane: Plane, observed: Observed, model: Fitted
) -> list[tuple[SpadParams, np.ndarray, np.ndarray]]:
    """Detector, delays and photons per pulse of wall points: the patches' with a fitted gain, and the background's."""
    moved = replace(plane, depth_m=model.response.depth_m)
    spad, sight = model.response.spad(scan), moved.seen_from(observed.wall_m)
    photons = model.loss(*sight, model.response.entrance_exponent) * model.fit.reflectance
    photons /= photons.sum(axis=1, keepdims=True)
    delay_bins = (2.0 * sight[0] / (SPEED_OF_LIGHT_MPS * scan.bin_s)).astype(np.int64)
    delay_s = (np.arange(scan.bins) + 0.5) * scan.bin_s
    shown = slice(window.first, window.stop)
    found = []
    for point, counts in enumerate(observed.counts):
        paths = np.bincount(np.minimum(delay_bins[point], scan.bins - 1), photons[point], scan.bins)
        shape = cells(expected_histogram(spad, delay_s, paths / spad.pulses)[shown])
        one = Observed(observed.wall_m[:1], counts[None], observed.background[point : point + 1])
        gain = fitted_gain(one, shape[None], np.array([counts.sum() / shape.sum()]), 20)
        late = np.zeros(scan.bins)
        late[shown] = np.repeat(observed.background[point], BINS_PER_CELL) / BINS_PER_CELL
        floor = float(late[shown].min())
        late[shown] -= floor
        ambient = msgspec.structs.replace(spad, ambient_rate_hz=floor / (spad.pulses * scan.bin_s))
        found.append((ambient, delay_s, (gain * paths + late) / spad.pulses))
    return found


def cells(histogram: np.ndarray) -> np.ndarray:
    return np.asarray(histogram.reshape(-1, BINS_PER_CELL).sum(axis=1))


def statistics(counts: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Chi-square per cell, and the Kolmogorov-Smirnov distance."""
    distance = np.cumsum(counts) / counts.sum() - np.cumsum(expected) / expected.sum()
    return float(np.mean(np.square(counts - expected) / expected)), float(np.abs(distance).max())


def described(values: list[tuple[float, float]]) -> dict:
    """Median and 90th percentile over wall points."""
    quantiles = np.quantile(np.array(values), [0.5, 0.9], axis=0)
    return {
        name: {"median": round(float(quantiles[0, at]), 4), "p90": round(float(quantiles[1, at]), 4)}
        for at, name in enumerate(("chi_square", "ks"))
    }


def compare(
    scan: ConfocalTransients, scene: Scene, plane: Plane, models: dict[str, Fitted], seed: int
) -> tuple[dict, list]:
    """Statistics of every model on wall points that no fit used, their null, and three examples to draw."""
    observed = Observed.of(scan, scene.window, *wall_points(scan, 0))
    shown = slice(scene.window.first, scene.window.stop)
    table: dict = {}
    examples = []
    for name, model in models.items():
        expected = []
        for spad, delay_s, photons in (points := simulated(scan, scene.window, plane, observed, model)):
            expected.append(cells(expected_histogram(spad, delay_s, photons)[shown]))
        table[name] = described([statistics(*pair) for pair in zip(observed.counts, expected, strict=True)])
        examples.append((name, expected))
    rng = np.random.default_rng(seed)
    drawn = [cells(draw_histogram(*point, rng)[shown]) for point in points]
    table["null"] = described([statistics(*pair) for pair in zip(drawn, expected, strict=True)])
    return table, [observed, examples]


def levels(scan: ConfocalTransients, window: Window, distance_m: float) -> dict:
    """Hidden counts over the wall's own, median of wall points, and the most that a matt plane of that size returns."""
    counts = scan.counts.astype(np.float64)
    floor = counts[..., window.quiet_first : window.quiet_stop].mean(axis=2)
    hidden = counts[..., window.first : window.stop].sum(axis=2) - floor * (window.stop - window.first)
    share = (2.0 * scan.half_width_m / distance_m) ** 2 / np.pi * (SPOT_RADIUS_M / distance_m) ** 2
    return {
        "measured": float(np.median(hidden / counts[..., : window.first].sum(axis=2))),
        "matt_at_most": float(share),
    }


def measured(
    scene: Scene, folder: Path, seed: int, evaluations: int
) -> tuple[dict, list, HiddenShape, ConfocalTransients]:
    scan = read_confocal(folder / scene.file)
    shape = hidden_shape(reconstruct(scan, FIRST_BIN), scan)
    plane = plane_patches(shape, scan, scene.side)
    observed = Observed.of(scan, scene.window, *wall_points(scan, 4))
    start = replace(scene.start, depth_m=shape.plane[0])
    fitted = fit_response(scan, scene.window, plane, observed, start, evaluations)
    fall_off = {
        f"{exponent:g}": round(
            fit_at(scan, scene.window, plane, observed, replace(fitted[0], entrance_exponent=exponent)).deviance
            - fitted[1].deviance, 1
        )
        for exponent in EXPONENTS
    }  # fmt: skip
    models = models_of(scan, scene, plane, observed, fitted)
    table, examples = compare(scan, scene, plane, models, seed)
    quiet = scan.counts[..., scene.window.quiet_first : scene.window.quiet_stop]
    own = scan.counts[..., :FIRST_BIN].sum(axis=2).ravel()
    found = {
        "distance_m": round(shape.distance_m, 4),
        "plane": [round(value, 4) for value in shape.plane],
        "tilt_deg": round(float(np.degrees(shape.tilt_rad)), 2),
        "snr": DEFAULT_SNR,
        "response": {**vars(fitted[0]), "irf_fwhm_s": fitted[0].rms_s * float(np.sqrt(8.0 * np.log(2.0)))},
        "deviance_over_entrance_exponent": fall_off,
        "deviance_of_models": {
            name: round(model.fit.deviance - fitted[1].deviance, 1) for name, model in models.items()
        },
        "floor_counts_per_bin": float(quiet.mean()),
        "floor_variance_over_mean": float(np.mean(quiet.var(axis=2) / np.maximum(quiet.mean(axis=2), 1e-9))),
        "floor_correlation_with_own_counts": float(np.corrcoef(own, quiet.mean(axis=2).ravel())[0, 1]),
        "level": levels(scan, scene.window, shape.distance_m),
        "histograms": table,
    }
    return found, examples, shape, scan


def draw_histograms(path: Path, scene: Scene, examples: list) -> None:
    """Three wall points, measured and by every model."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    observed, models = examples
    time_ns = (np.arange(observed.counts.shape[1]) + 0.5) * BINS_PER_CELL * 4e-3 + scene.window.first * 4e-3
    figure = Figure(figsize=(11.0, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, point in zip(figure.subplots(1, 3), (9, 27, 54), strict=True):
        axes.step(time_ns, observed.counts[point], color="0.6", lw=0.8, where="mid", label="measured")
        for name, expected in (models[0], models[-1]):
            axes.plot(time_ns, expected[point], lw=1.2, label=name)
        axes.set(xlabel="time since the wall's return [ns]", title=f"wall point {point}")
    figure.axes[0].set_ylabel("photons in 16 ps")
    figure.axes[0].legend(fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_data_option(parser)
    parser.add_argument("--out", type=Path, help="folder for pictures")
    parser.add_argument("--evaluations", type=int, default=45, help="responses tried in a fit")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scene", choices=list(SCENES), action="append")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    data = capture_folder(parser, arguments.data, "spad_cnlos")
    result: dict = {"seed": arguments.seed, "evaluations": arguments.evaluations}
    for name in arguments.scene or SCENES:
        found, examples, shape, scan = measured(SCENES[name], data, arguments.seed, arguments.evaluations)
        result[name] = found
        if arguments.out:
            arguments.out.mkdir(parents=True, exist_ok=True)
            stem = name.replace(" ", "-")
            draw_shape(shape, scan, arguments.out / f"{stem}.png", name)
            draw_histograms(arguments.out / f"{stem}-histograms.png", SCENES[name], examples)
    print(json.dumps(result) if arguments.json else json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
