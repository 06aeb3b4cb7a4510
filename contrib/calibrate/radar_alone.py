"""Calibration of the radar alone from a capture: its open-field background, its noise floor."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from contrib.calibrate.background import (
    MIN_SCANS,
    BackgroundQuality,
    background_of,
    background_quality,
    mean_chirp,
)
from contrib.calibrate.capture import Capture, complete_scans
from contrib.calibrate.front_end_faults import FaultParams
from contrib.calibrate.noise_floor import NoiseFloor, NoiseMeter
from msgs.files.whole_files import whole
from msgs.values.units import db_from_ratio


def measure_background(
    capture: Capture, scans: int, on_scan: Callable[[], None] = lambda: None
) -> tuple[np.ndarray, BackgroundQuality]:
    """Background complex64 [beams, samples] in codes and its quality, of up to so many complete scans.

    Raises ValueError naming the file where it has too few.
    """
    setup = capture.setup
    shape = setup.radar.chirps_per_beam, setup.radar.samples_per_chirp, 2
    beams = []
    for scan in complete_scans(capture.beams(), len(setup.beams), on_scan, scans):
        for beam in scan:
            if beam.samples.shape != shape or beam.full_scale_dbm != setup.full_scale_dbm:
                raise ValueError(
                    f"{capture.path}: beam {beam.beam_index} of scan {beam.scan_id} is not of the set-up: "
                    f"samples {beam.samples.shape}, full_scale_dbm {beam.full_scale_dbm!r}"
                )
        beams.append(np.stack([mean_chirp(beam) for beam in scan]))
    if len(beams) < MIN_SCANS:
        raise ValueError(f"{capture.path}: a background needs at least {MIN_SCANS} complete scans, got {len(beams)}")
    chirps = np.stack(beams)
    background, outlier_share = background_of(chirps)
    try:
        return background, background_quality(chirps, setup, outlier_share)
    except ValueError as error:
        raise ValueError(f"{capture.path}: {error}") from None


def measure_noise(
    capture: Capture, scans: int, faults: FaultParams | None = None, on_scan: Callable[[], None] = lambda: None
) -> NoiseFloor:
    """Noise floor and faults of up to so many scans; ValueError naming the file."""
    try:
        meter, scan_ids = NoiseMeter(capture.setup, faults), set[int]()
        for beam in capture.beams():
            if beam.scan_id not in scan_ids and len(scan_ids) == scans:
                break
            meter.add(beam)
            scan_ids.add(beam.scan_id)
            if beam.beam_index == beam.beam_count - 1:
                on_scan()
        return meter.result()
    except ValueError as error:
        raise ValueError(str(error) if str(capture.path) in str(error) else f"{capture.path}: {error}") from None


def receiver_text(floor: NoiseFloor, scene: Path | None) -> str:
    """YAML of a scene with this receiver, or of its `radar` block alone."""
    if scene is not None:
        return scene_with_receiver(scene, floor)
    return yaml.safe_dump({"radar": receiver_of(floor)}, sort_keys=False)


def receiver_of(floor: NoiseFloor) -> dict[str, Any]:
    """The `radar` block of a scene whose receiver has this floor."""
    front_end: dict[str, Any] = {}
    if floor.flicker_corner_hz > 0.0:
        front_end["flicker_corner_hz"] = float(f"{floor.flicker_corner_hz:.6g}")
    if floor.spurs:
        front_end["spurs"] = [
            {"frequency_hz": float(f"{spur.frequency_hz:.9g}"), "power_dbm": round(spur.power_dbm, 3)}
            for spur in floor.spurs
        ]
    front_end |= {name: float(f"{value:.6g}") for name, value in _static_faults(floor).items()}
    block: dict[str, Any] = {"noise_figure_db": round(floor.noise_figure_db, 4)}
    return {**block, "front_end": front_end} if front_end else block


def _static_faults(floor: NoiseFloor) -> dict[str, float]:
    """Fields of a scene's front end that hold the measured leakage and imbalance."""
    fields: dict[str, float] = {}
    if floor.leakage is not None:
        fields |= {"leakage_dbm": floor.leakage.power_dbm, "leakage_range_m": floor.leakage.range_m}
    if floor.imbalance is not None:
        fields |= {"iq_gain_db": floor.imbalance.gain_db, "iq_phase_deg": floor.imbalance.phase_deg}
    return fields


def scene_with_receiver(path: Path, floor: NoiseFloor) -> str:
    """The scene of a file as YAML, with this receiver; faults of its front end that were not measured stay."""
    from sim_player.scene.description import check_scene, load_scene, scene_to_yaml
    from sim_player.scene.front_end import Spur

    scene = load_scene(path)
    spurs = tuple(Spur(frequency_hz=spur.frequency_hz, power_dbm=spur.power_dbm) for spur in floor.spurs)
    front_end = msgspec.structs.replace(
        scene.radar.front_end, flicker_corner_hz=floor.flicker_corner_hz, spurs=spurs, **_static_faults(floor)
    )
    radar = msgspec.structs.replace(scene.radar, noise_figure_db=floor.noise_figure_db, front_end=front_end)
    scene = msgspec.structs.replace(scene, radar=radar)
    check_scene(scene)
    return scene_to_yaml(scene)


def floor_lines(floor: NoiseFloor, faults: FaultParams) -> list[str]:
    """Return what was measured of noise, spurs, leakage, imbalance and sidebands, and what was not, for people."""
    lines = [
        f"white: {floor.power_dbm:.2f} dBm over the band, {floor.bin_dbm:.2f} dBm per bin of a beam, noise figure "
        f"{floor.noise_figure_db:.2f} dB; beams differ by {floor.beam_spread_db:.2f} dB at most",
        f"1/f corner: {floor.flicker_corner_hz / 1e3:.1f} kHz; rms from the model {floor.model_rms_db:.2f} dB",
    ]
    lines += [f"spur: {spur.power_dbm:.1f} dBm at {spur.frequency_hz / 1e6:.4f} MHz" for spur in floor.spurs]
    if floor.leakage is not None:
        lines.append(f"leakage: {floor.leakage.power_dbm:.1f} dBm at {floor.leakage.range_m:.2f} m")
    elif faults.leakage_to_m is not None:
        lines.append(f"leakage: nothing stands above the noise up to {faults.leakage_to_m:g} m")
    if floor.imbalance is not None:
        image = floor.imbalance
        lines.append(
            f"I/Q: gain {image.gain_db:.2f} dB, phase {image.phase_deg:.2f} deg, image {image.image_db:.1f} dB "
            f"(standard deviation {100.0 * image.std_share:.0f} % of it)"
        )
    elif faults.image_about_hz is not None:
        lines.append("I/Q: no image is resolved")
    lines += [
        f"sideband: {sideband.level_db:.1f} dB at +-{sideband.frequency_hz:.0f} Hz of every echo; not simulated"
        for sideband in floor.sidebands
    ]
    return lines


def save_background(values: np.ndarray, out: Path) -> None:
    """Write a background [beams, samples] as an array file."""
    with whole(out) as part, part.open("wb") as file:
        np.save(file, values)


def draw_background(background: np.ndarray, capture: Capture, path: Path) -> None:
    """Power of the background against range and beam."""
    from mirrorwave.plots.style import new_figure, save

    radar = capture.setup.radar
    spectra = np.fft.fft(background, axis=1) / radar.samples_per_chirp
    if capture.setup.beat_sign < 0:
        spectra = np.roll(spectra[:, ::-1], 1, axis=1)
    power = np.abs(spectra[:, : min(512, radar.samples_per_chirp // 2)]) ** 2
    power_dbm = 10.0 * np.log10(np.maximum(power, 1e-30)) + db_from_ratio(capture.setup.milliwatt_per_code_squared)
    figure = new_figure(9.0, 5.0)
    axes = figure.subplots()
    range_m = radar.range_bin_m * np.arange(power.shape[1])
    azimuth_deg = np.array(capture.setup.beams.azimuth_deg)
    image = axes.pcolormesh(range_m, azimuth_deg, power_dbm, shading="nearest")
    figure.colorbar(image, label="dBm per bin")
    axes.set(xlabel="range [m]", ylabel="beam azimuth [deg]", title="Open-field background")
    save(figure, path)


def draw_noise(floor: NoiseFloor, path: Path) -> None:
    """Floor against range, measured and modelled, and the level of each beam."""
    from mirrorwave.plots.style import legend_below, new_figure, save

    figure = new_figure(10.0, 4.6)
    against_range, beams = figure.subplots(1, 2)
    range_m = [band.range_m for band in floor.bands]
    against_range.semilogx(range_m, [band.measured_dbm for band in floor.bands], "o", label="measured")
    against_range.semilogx(range_m, [band.modelled_dbm for band in floor.bands], "-", label="model")
    against_range.set(xlabel="range [m]", ylabel="level of a bin of a beam [dBm]", title="Noise floor")
    legend_below(against_range, columns=2)
    beams.plot(floor.beam_power_dbm, "o")
    beams.set(xlabel="beam", ylabel="white noise over the band [dBm]", title="Beams")
    for axes in (against_range, beams):
        axes.grid(alpha=0.3)
    save(figure, path)
