"""One recorded burst of a real Phaser board beside the simulated burst of a scene with its measured receiver.

    python -m benchmarks.simulator.real_burst --data DIR [--out PICTURE.png]

DIR holds the folder `xband_cn0566_fmcw`: 32 chirps of one summed channel. They pass the driver's own `beam_samples`,
`mirrorwave calibrate noise` measures them, and the scene it writes is simulated with the driver's chirp. The scene is
one person 6.5 m ahead, as strong as the strongest echo: a place without truth has no scene.

The burst was scaled to a peak of 200 and rounded: absolute powers, gains and with them the noise figure cannot be
known, so levels are relative to the strongest echo, or to the leakage.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks.captures import add_data_option, capture_folder
from contrib.boards.phaser_model import (
    CHIRP_INTERVAL_S,
    INTERVAL_SAMPLES,
    OFFSET_HZ,
    SAMPLE_RATE_HZ,
    SAMPLES_PER_CHIRP,
    PhaserCalibration,
    PhaserParams,
    beam_samples,
    beam_table,
    radar_setup,
)
from contrib.calibrate.capture import Capture
from contrib.calibrate.front_end_faults import FaultParams
from contrib.calibrate.noise_floor import NoiseFloor
from contrib.calibrate.radar_alone import measure_noise, scene_with_receiver
from msgs.recording.sigmf import write_capture
from msgs.values.radar import BeamGrid, RadarBeam, RadarSetup
from sim_player.player import ScenePlayer
from sim_player.scene.description import Scene, load_scene

PARAMS = PhaserParams(chirps_per_beam=32)
BEAMS = BeamGrid(azimuth_deg=(0.0,))
#: Leakage lies at 1.2 m, the next echo at 3 m. The board mirrors at its intermediate frequency: beats are shifted by
#: the tone's offset afterwards.
FAULTS = FaultParams(leakage_to_m=2.5, image_about_hz=-OFFSET_HZ)
SCENE = """
name: burst
objects:
  - {class: pedestrian, x_m: 6.5, y_m: 0.0}
"""
EFFECTS = "los_objects,los_surfaces,thermal_noise,flicker,leakage,spurs,iq_imbalance,adc"
#: Where the strongest echo lies, and where the floor is read.
ECHO_M = (2.5, 60.0)
FLOORS_M = ((20.0, 60.0), (100.0, 150.0))
#: Doppler frequencies beyond those of echoes at rest and their sidebands.
STILL_HZ = 400.0


def recorded_burst(data: Path) -> np.ndarray:
    """Return the straight part of each ramp, complex [32, 1024]."""
    folder = data / "xband_cn0566_fmcw" / "hex"
    words = [
        np.array([int(word, 16) for word in (folder / f"post_ddc_{part}.hex").read_text().split()]) for part in "iq"
    ]
    codes = [np.where(word >= 1 << 15, word - (1 << 16), word) for word in words]
    return np.asarray((codes[0] + 1j * codes[1]).reshape(PARAMS.chirps_per_beam, SAMPLES_PER_CHIRP))


def setup() -> RadarSetup:
    """Return the set-up of the burst: one beam ahead."""
    return radar_setup(PARAMS, BEAMS, beam_table(PARAMS, PhaserCalibration(), BEAMS).weights)


def driven_beam(burst: np.ndarray) -> RadarBeam:
    """Return the beam that the driver makes of a burst of one summed channel, complex [chirps, samples]."""
    channel = np.zeros((PARAMS.chirps_per_beam, INTERVAL_SAMPLES), complex)
    first = round(PARAMS.settle_s * SAMPLE_RATE_HZ)
    channel[:, first : first + SAMPLES_PER_CHIRP] = burst
    samples = beam_samples([channel.ravel(), np.zeros(channel.size)], PARAMS)
    return RadarBeam(
        stamp_ns=0, scan_id=0, beam_index=0, beam_count=1, azimuth_rad=0.0, samples=samples,
        full_scale_dbm=PARAMS.full_scale_dbm,
    )  # fmt: skip


def measured(beam: RadarBeam, faults: FaultParams, path: Path) -> NoiseFloor:
    """Return what `mirrorwave calibrate noise` measures of one beam, by way of a capture at a path."""
    write_capture(path, setup(), iter([beam]))
    return measure_noise(Capture(path), 1, faults)


def simulated(floor: NoiseFloor, real: RadarBeam, folder: Path, seed: int) -> RadarBeam:
    """Return the simulated beam of the scene with the measured receiver, its echo as strong as the strongest real one.

    The burst's gain is unknown, so the transmitter's power is fitted.
    """
    path = folder / "scene.yaml"
    path.write_text(scene_with_receiver(_scene_file(folder), floor))
    scene = load_scene(path)
    plain = setup()
    noisy = msgspec.structs.replace(plain.radar, noise_figure_db=scene.setup.radar.noise_figure_db)
    first = played(scene, msgspec.structs.replace(plain, radar=noisy), seed)
    gain_db = _echo_db(real) - _echo_db(first)
    louder = msgspec.structs.replace(noisy, transmit_power_w=noisy.transmit_power_w * 10.0 ** (0.1 * gain_db))
    return played(scene, msgspec.structs.replace(plain, radar=louder), seed)


def _scene_file(folder: Path) -> Path:
    path = folder / "plain.yaml"
    path.write_text(SCENE)
    return path


def played(scene: Scene, radar_setup: RadarSetup, seed: int) -> RadarBeam:
    """Return the beam of a scene under a set-up, with the effects of direct echoes and of the receiver."""
    return ScenePlayer(scene, seed, setup=radar_setup, effects=EFFECTS).beam(0, 0)


def beats(beam: RadarBeam) -> np.ndarray:
    """Return a beam's samples in codes, complex128 [chirps, samples]."""
    return beam.samples.astype(np.float64).view(np.complex128)[..., 0]


def profile_db(beam: RadarBeam) -> tuple[np.ndarray, np.ndarray]:
    """Return ranges [m], negative ones for negative beats, and Hann levels in dB of a code, mean over chirps [bins]."""
    values = beats(beam)
    window = np.hanning(values.shape[1] + 1)[:-1]
    spectra = np.fft.fftshift(np.fft.fft(values * window, axis=1), axes=1) / window.sum()
    bins = np.fft.fftshift(np.fft.fftfreq(values.shape[1], 1.0 / values.shape[1]))
    return bins * setup().radar.range_bin_m, 10.0 * np.log10(np.mean(np.abs(spectra) ** 2, axis=0))


def _echo_db(beam: RadarBeam) -> float:
    range_m, level_db = profile_db(beam)
    return float(level_db[(range_m > ECHO_M[0]) & (range_m < ECHO_M[1])].max())


def _noise_db(beam: RadarBeam, low_m: float, high_m: float) -> float:
    """Return the mean noise of cells of range and Doppler that no echo at rest reaches, in dB of the strongest echo."""
    values = beats(beam)
    slow, fast = (np.hanning(count + 1)[:-1] for count in values.shape)
    power = np.abs(np.fft.fft2(values * slow[:, None] * fast)) ** 2
    range_m = np.fft.fftfreq(len(fast), 1.0 / len(fast)) * setup().radar.range_bin_m
    frequency_hz = np.fft.fftfreq(len(slow), CHIRP_INTERVAL_S)
    cells = power[np.abs(frequency_hz) > STILL_HZ][:, (range_m >= low_m) & (range_m < high_m)]
    echo = power[0, (range_m > ECHO_M[0]) & (range_m < ECHO_M[1])].max()
    return round(10.0 * float(np.log10(np.median(cells) / np.log(2.0) / echo)), 1)


def _negative(range_m: np.ndarray, level_db: np.ndarray) -> dict[str, float]:
    """Return the strongest negative beat beyond the leakage, and the level where it would be mirrored from."""
    at = int(np.argmax(np.where(range_m < -10.0, level_db, -np.inf)))
    shift_m = 2.0 * OFFSET_HZ / SAMPLE_RATE_HZ * SAMPLES_PER_CHIRP * setup().radar.range_bin_m
    mirror_m = -float(range_m[at]) - shift_m
    mirror_db = float(level_db[np.abs(range_m - mirror_m) < 2.0 * setup().radar.range_bin_m].max())
    return {
        "range_m": round(float(range_m[at]), 2), "level_db": round(float(level_db[at]), 1),
        "mirror_m": round(mirror_m, 2), "mirror_db": round(mirror_db, 1),
    }  # fmt: skip


def figures(beam: RadarBeam, floor: NoiseFloor) -> dict[str, Any]:
    """Return the figures of a beam, levels in dB of its strongest echo."""
    range_m, level_db = profile_db(beam)
    echo_db = _echo_db(beam)
    shown = (range_m > ECHO_M[0]) & (range_m < ECHO_M[1])
    reference_dbm = floor.leakage.power_dbm if floor.leakage else np.nan
    return {
        "strongest_m": round(float(range_m[shown][level_db[shown].argmax()]), 2),
        "strongest_db_of_full_scale": round(echo_db - 20.0 * np.log10(32768.0), 1),
        "floor_db": {
            f"{low:g}..{high:g} m": round(float(np.median(level_db[(range_m >= low) & (range_m < high)])) - echo_db, 1)
            for low, high in FLOORS_M
        },
        "noise_db": {f"{low:g}..{high:g} m": _noise_db(beam, low, high) for low, high in FLOORS_M},
        "strongest_negative": _negative(range_m, level_db - echo_db),
        "leakage": None if floor.leakage is None else {
            "range_m": round(floor.leakage.range_m, 2),
            "level_db": round(reference_dbm - PARAMS.full_scale_dbm + 20.0 * np.log10(32768.0) - echo_db, 1),
        },
        "imbalance": None if floor.imbalance is None else msgspec.to_builtins(floor.imbalance),
        "sidebands": [(round(one.frequency_hz), round(one.level_db, 1)) for one in floor.sidebands],
        "spurs_khz_db_of_leakage": [
            (round(spur.frequency_hz / 1e3, 1), round(spur.power_dbm - reference_dbm, 1)) for spur in floor.spurs
        ],
        "flicker_corner_khz": round(floor.flicker_corner_hz / 1e3, 1),
        "model_rms_db": round(floor.model_rms_db, 2),
    }  # fmt: skip


def compare(data: Path, seed: int) -> tuple[dict[str, Any], RadarBeam, RadarBeam]:
    """Return the figures of the real and the simulated burst, and both beams."""
    real = driven_beam(recorded_burst(data))
    with tempfile.TemporaryDirectory() as folder:
        room = Path(folder)
        floor = measured(real, FAULTS, room / "real.sigmf-meta")
        twin = simulated(floor, real, room, seed)
        # the simulated receiver mirrors at zero beat
        twin_floor = measured(twin, msgspec.structs.replace(FAULTS, image_about_hz=0.0), room / "twin.sigmf-meta")
    return {"real": figures(real, floor), "simulated": figures(twin, twin_floor)}, real, twin


def draw(real: RadarBeam, twin: RadarBeam, path: Path) -> None:
    """Draw both profiles over range, negative beats included, and both sums over range against Doppler frequency."""
    from mirrorwave.plots.style import legend_below, new_figure, save

    figure = new_figure(10.0, 4.6)
    ranges, doppler = figure.subplots(1, 2)
    for beam, name in ((real, "real"), (twin, "simulated")):
        range_m, level_db = profile_db(beam)
        ranges.plot(range_m, level_db - _echo_db(beam), linewidth=0.8, label=name)
        values = beats(beam)
        window = np.hanning(len(values) + 1)[:-1, None]
        power = (np.abs(np.fft.fftshift(np.fft.fft(values * window, axis=0), axes=0)) ** 2).sum(axis=1)
        frequency_hz = np.fft.fftshift(np.fft.fftfreq(len(values), CHIRP_INTERVAL_S))
        doppler.plot(frequency_hz, 10.0 * np.log10(power / power.max()), ".-", label=name)
    ranges.set(xlabel="range [m]", ylabel="level [dB of the strongest echo]", title="Range profile", xlim=(-80, 160))
    doppler.set(xlabel="Doppler frequency [Hz]", ylabel="sum over ranges [dB]", title="Sidebands")
    for axes in (ranges, doppler):
        axes.grid(alpha=0.3)
        legend_below(axes, columns=2)
    save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_data_option(parser)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows, real, twin = compare(capture_folder(parser, options.data, "xband_cn0566_fmcw").parent, options.seed)
    print(json.dumps(rows, indent=1))
    if options.out:
        draw(real, twin, options.out)


if __name__ == "__main__":
    main()
