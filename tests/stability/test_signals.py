"""Hard signals: silence, one chirp, huge offsets, rails, one beam; finite answers and no warnings (they are errors)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from contrib.boards.digital_array import DigitalArrayParams, range_doppler
from lab.tradeoff.literal_signal import literal_echoes
from models.perception.find.peaks import PeakParams, peaks_at
from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import FormingParams
from models.perception.form.slow_time_sums import SATURATION_CODE, fold_chirps, group_edges
from models.physics.waveform import beat_frequency_hz, beat_phase_rad, beat_samples, range_profile, window_noise_gain
from msgs.values.perception import PathClass, Peaks
from msgs.values.radar import BeamGrid, RadarParams, RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from sim_player.scene.front_end import FrontEnd, Spur
from sim_player.signal.fmcw import beam_weights, noise_bank
from sim_player.signal.levels import beam_beats, echo_terms, kernel_profiles, record_beam
from sim_player.signal.receiver import flicker_ratio, spur_profile
from sim_player.signal.switches import PLAIN, SignalEffects
from sim_player.trace.path_table import Paths
from tests.builders import beam_of, example_beam, example_map
from tests.sim_player.signal.references import ALL, beat_terms, converted
from tests.sim_player.signal.test_levels import some_paths
from tests.stability.catalogue import Errors


def _setup(chirps: int = 4, samples: int = 2048, beams: int = 25) -> RadarSetup:
    radar = RadarParams(sample_rate_hz=1.5e9 * samples / 8192, samples_per_chirp=samples, chirps_per_beam=chirps)
    return RadarSetup(radar=radar, beams=BeamGrid(azimuth_deg=tuple(float(-60 + 5 * beam) for beam in range(beams))))


def _form(setup: RadarSetup, samples: np.ndarray, state: VehicleState | None = None, **params: Any) -> RangeAzimuthMap:
    """Every beam brings the same samples."""
    former = RaFormer(setup, FormingParams(**params))
    maps = []
    for index in range(len(setup.beams)):
        maps += former.add(beam_of(setup, index, samples), state)
    assert np.isfinite(maps[0].values).all()
    return maps[0]


@pytest.mark.parametrize("mode", ["coherent", "welch"])
@pytest.mark.parametrize("state", [None, VehicleState(stamp_ns=0, speed_mps=30.0, yaw_rate_rps=-0.5)])
def test_silence(mode: str, state: VehicleState | None) -> None:
    setup = _setup()
    formed = _form(setup, np.zeros((4, 2048, 2), np.int16), state, mode=mode)
    assert not formed.values.any()
    assert formed.noise_power_mw == 0.0
    assert formed.saturated_share == 0.0


@pytest.mark.parametrize("mode", ["coherent", "welch"])
@pytest.mark.parametrize(("chirps", "beams"), [(1, 25), (3, 2), (1, 2)])
def test_one_chirp_two_beams(mode: str, chirps: int, beams: int) -> None:
    setup = _setup(chirps=chirps, beams=beams)
    samples = np.random.default_rng(3).integers(-100, 100, (chirps, 2048, 2)).astype(np.int16)
    formed = _form(setup, samples, mode=mode)
    assert formed.noise_power_mw > 0.0


@pytest.mark.parametrize("code", [32767, -32768])
def test_rails(code: int) -> None:
    """Every sample at full scale: all of it in range bin 0 (and the window's neighbour), and the map says so."""
    setup = _setup(chirps=128)
    formed = _form(setup, np.full((128, 2048, 2), code, np.int16))
    assert formed.saturated_share == 1.0
    assert np.abs(formed.values[2:]).max() <= 1e-6 * np.abs(formed.values[0]).max()


@pytest.mark.hard("models.perception.form.ra_forming", "no window", 0.015, "of the echo",
                  "five sigma of noise, sqrt(1.5 / 2^15) / 3 each, and Hann's side lobe 100 bins out, 1e4 / (pi "
                  "1e6)")  # fmt: skip
def test_huge_offset_beside_a_weak_echo(errors: Errors) -> None:
    """30000 codes half a bin off zero, an echo of 3 codes 100 bins further: 1 / (pi 100) of the one is 30 times the
    other.
    """
    setup = _setup(chirps=16)
    radar = setup.radar
    rng = np.random.default_rng(7)
    spur = np.exp(2j * np.pi * 0.5 * np.arange(2048) / 2048)
    echo = 3.0 * beat_samples(radar, np.array([200 * radar.range_bin_m]))[0]
    noise = rng.normal(size=(16, 2048, 2))
    beat = 30000.0 * spur + echo
    samples = np.rint(np.stack([beat.real, beat.imag], axis=-1) + noise).astype(np.int16)
    exact = 3.0 * np.sqrt(setup.milliwatt_per_code_squared)

    def error(window: str) -> float:
        return float(abs(abs(_fold(setup, samples, range_window=window)[0][100]) / exact - 1.0))

    errors(naive=error("none"), ours=error("hann"))


def _fold(setup: RadarSetup, samples: np.ndarray, **params: Any) -> tuple[np.ndarray, float]:
    """Profile and noise power of the beam straight ahead."""
    middle = len(setup.beams) // 2
    beam = example_beam(
        beam_index=middle, beam_count=len(setup.beams), samples=samples, full_scale_dbm=setup.full_scale_dbm
    )
    profile, noise_power_mw, *_ = RaFormer(setup, FormingParams(**params)).folder.fold(beam)
    return profile, noise_power_mw


def _bin_noise_mw(setup: RadarSetup, codes_rms: float, averaged: int = 1) -> float:
    """Noise of a Hann bin under so many codes rms a component, rounding included, `averaged` samples of each."""
    per_sample = 2.0 * (codes_rms**2 + 1.0 / 12.0) * setup.milliwatt_per_code_squared
    return per_sample * window_noise_gain("hann") / (averaged * setup.radar.samples_per_chirp)


@pytest.mark.hard("models.perception.form.ra_forming", "mean square less squared mean, float32", 0.1, "",
                  "four sigma of a median over 6600 bins: 1.44 / sqrt(n), 1.4 times for what a window shares between "
                  "bins")  # fmt: skip
def test_noise_under_a_huge_offset(errors: Errors) -> None:
    """30000 codes of offset and noise of 2: squares of 9e8 are known to 64 where 4 is looked for. Relative error."""
    setup = _setup(chirps=1, samples=8192)
    rng = np.random.default_rng(7)
    codes = np.rint(30000.0 + 2.0 * rng.normal(size=(1, 8192, 2))).astype(np.int16)
    exact = _bin_noise_mw(setup, 2.0)
    plain = codes.astype(np.float32)
    variance = float(np.mean(plain * plain) - np.mean(plain) ** 2)
    naive = 2.0 * variance * setup.milliwatt_per_code_squared * window_noise_gain("hann") / 8192
    errors(naive=abs(naive / exact - 1.0), ours=abs(_fold(setup, codes)[1] / exact - 1.0))


@pytest.mark.hard("models.perception.form.ra_forming", "spread between chirps", 0.41, "",
                  "no independence between chirps: at most 1 - ln 2 = 0.31 low; four sigma of a median over 6600 "
                  "bins: 0.1")  # fmt: skip
@pytest.mark.parametrize("chirps", [1, 16], ids=["one chirp", "all chirps alike"])
def test_welch_with_zero_variance(chirps: int, errors: Errors) -> None:
    """Noise that repeats from chirp to chirp has no spread, one chirp alone not even that (0 / 0). Relative error."""
    setup = _setup(chirps=chirps, samples=8192)
    rng = np.random.default_rng(23)
    codes = np.repeat(np.rint(100.0 * rng.normal(size=(1, 8192, 2))).astype(np.int16), chirps, axis=0)
    exact = _bin_noise_mw(setup, 100.0)
    spectra = np.fft.fft(codes[..., 0] + 1j * codes[..., 1], axis=1)[:, 1024:]
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = np.sum(np.abs(spectra - spectra.mean(axis=0)) ** 2, axis=0) / np.float64(chirps - 1)
    naive = np.median(spread) / np.log(2.0) * setup.milliwatt_per_code_squared * 1.5 / 8192**2
    errors(naive=abs(naive / exact - 1.0), ours=abs(_fold(setup, codes, mode="welch")[1] / exact - 1.0))


@pytest.mark.hard("models.perception.form.ra_forming", "median over ln 2", 0.02, "",
                  "four sigma of a median over 6600 bins of 128 chirps: 1.25 / sqrt(128 n), 1.4 times for the "
                  "window")  # fmt: skip
def test_welch_of_many_chirps(errors: Errors) -> None:
    """The power of 128 chirps hardly varies: its median is its mean, not ln 2 of it. Relative error of the noise."""
    setup = _setup(chirps=128, samples=8192)
    codes = np.rint(100.0 * np.random.default_rng(29).standard_normal((128, 8192, 2), np.float32)).astype(np.int16)
    exact = _bin_noise_mw(setup, 100.0)
    spectra = np.fft.fft((codes[..., 0] + 1j * codes[..., 1])[:, :, None], axis=1)[:, 1024:, 0]
    naive = np.median(np.mean(np.abs(spectra) ** 2, axis=0)) / np.log(2.0)
    naive *= setup.milliwatt_per_code_squared * window_noise_gain("hann") / 8192**2
    errors(naive=abs(naive / exact - 1.0), ours=abs(_fold(setup, codes, mode="welch")[1] / exact - 1.0))


@pytest.mark.hard("models.perception.form.slow_time_sums", "sum of int16", 0.0, "codes", "integers are exact")
@pytest.mark.parametrize("code", [32767, -32768])
def test_sums_of_128_chirps_at_full_scale(code: int, errors: Errors) -> None:
    """2^22 in 16 bits: what is left is -128 or 0."""
    samples = np.full((128, 16, 2), code, np.int16)
    sums, _ = fold_chirps(samples, 1)
    naive = samples.sum(axis=0, dtype=np.int16).astype(np.int64)
    errors(naive=np.abs(naive - 128 * code).max(), ours=np.abs(sums.astype(np.int64) - 128 * code).max())


@pytest.mark.hard("models.perception.form.slow_time_sums", "sum of int32", 0.0, "codes",
                  "integers are exact; more than 65536 chirps a group are refused")  # fmt: skip
def test_sums_beyond_32_bits(errors: Errors) -> None:
    """65537 chirps at -32768: one more than an int32 holds, and the sum turns positive. Two groups hold them."""
    chirps = 65537
    samples = np.full((chirps, 1, 2), -32768, np.int16)
    with pytest.raises(ValueError, match="chirps per group must be at most 65536"):
        group_edges(chirps, 1)
    sums, _ = fold_chirps(samples, 2)
    naive = samples.sum(axis=0, dtype=np.int32).astype(np.int64)
    exact = -32768 * chirps
    errors(naive=np.abs(naive - exact).max(), ours=np.abs(sums.sum(axis=0, dtype=np.int64) - exact).max())


@pytest.mark.hard("models.perception.form.slow_time_sums", "|code| >= 32767 in int16", 0.0, "of the samples",
                  "counting is exact")  # fmt: skip
def test_saturation_at_the_lower_rail(errors: Errors) -> None:
    """|-32768| is -32768 in 16 bits: the rail that most converters reach goes unnoticed. Share missed."""
    samples = np.full((5, 16, 2), -32768, np.int16)
    _, saturated = fold_chirps(samples, 1)
    naive = (np.abs(samples) >= SATURATION_CODE).any(axis=-1).mean()
    errors(naive=1.0 - naive, ours=1.0 - saturated / 80)


@pytest.mark.hard("sim_player.signal.fmcw", "cast without a clip", 0.5, "codes",
                  "rounding to the nearest code within the rails")  # fmt: skip
def test_converter_past_full_scale(errors: Errors) -> None:
    """40000 codes wrap around to -25536: a strong echo changes sign."""
    level = np.array([40000.0 - 40000.0j, 32767.4 + 1e9j, -5e8 + 0.3j])
    both = np.stack([level.real, level.imag], axis=-1)
    limited = np.clip(both, -32768.0, 32767.0)
    naive = np.rint(both).astype(np.int64).astype(np.int16)
    errors(naive=np.abs(naive - limited).max(), ours=np.abs(converted(level) - limited).max())


@pytest.mark.hard("contrib.boards.digital_array", "transformed as it is", 0.0, "of the cells",
                  "refused: no cell is given out")  # fmt: skip
@pytest.mark.parametrize("value", [np.nan, np.inf], ids=["NaN", "Inf"])
def test_a_float_capture_that_is_not_finite(value: float, errors: Errors) -> None:
    """One sample in 16384: its transform fills every cell of its channel, and beams add all channels. Share spoilt."""
    samples = np.ones((16, 8, 128), np.complex64)
    samples[3, 2, 40] = value
    with np.errstate(invalid="ignore"):
        beams = np.fft.fft2(samples, axes=(0, 2)).sum(axis=1)
    with pytest.raises(ValueError, match="samples must be finite, got 1 that are not"):
        range_doppler(samples, DigitalArrayParams())
    errors(naive=1.0 - np.isfinite(beams).mean(), ours=0.0)


@pytest.mark.hard("contrib.boards.digital_array", "mean of complex64", 0.06, "",
                  "rounding of 1e6 in float32, half a unit")  # fmt: skip
def test_what_stands_still_at_a_million(errors: Errors) -> None:
    """4096 chirps of 1e6 summed in float32: a still echo of 20 is left of what was to be taken off."""
    samples = np.full((4096, 1, 16), 1e6 * (0.7 + 0.3j), np.complex64)
    params = DigitalArrayParams(remove_static=True, channel_slot=(0,), channel_y_m=(0.0,))
    errors(naive=np.abs(samples - samples.mean(axis=0)).max(), ours=np.abs(range_doppler(samples, params)).max())


@pytest.mark.hard("sim_player.signal.levels", "phase of every sample in float32", 1e-4, "of the largest sample",
                  "the tolerances of the low rate, 1e-5, and of slow time, 1e-5, over a band half full")  # fmt: skip
@pytest.mark.parametrize("count", [1, 20_000])
def test_fast_echoes_near_and_far(count: int, errors: Errors) -> None:
    """From 0.5 to 200 m at up to 40 m/s, first and last of 128 chirps, every 101st sample; a lone echo at 200 m."""
    setup, rng = RadarSetup(), np.random.default_rng(4)
    radar, beam = setup.radar, 12
    paths = replace(
        some_paths(count, 400.0, speed_mps=40.0),
        length_m=np.append(rng.uniform(1.0, 400.0, count - 1), 400.0),
        radial_speed_mps=np.append(rng.uniform(-40.0, 40.0, count - 1), 40.0),
    )
    beats, carrier, basis = echo_terms(setup, paths, PLAIN, beam=beam, precision="float32")
    sample, chirps = np.arange(0, 8192, 101), np.array([0, 127])
    got = ((carrier[:, None] * basis.T)[chirps] @ beats)[:, sample]
    weights = beam_weights(setup, paths, slice(beam, beam + 1))[0] * np.exp(1j * beat_phase_rad(radar, paths.length_m))
    cycles = beat_frequency_hz(radar, paths.length_m) / radar.sample_rate_hz
    turns = 2.0 * paths.radial_speed_mps * radar.chirp_period_s / radar.wavelength_m
    start = np.exp(2j * np.pi * np.multiply.outer(chirps - 63.5, turns)) * weights
    exact = start @ np.exp(2j * np.pi * (np.multiply.outer(cycles, sample) % 1.0))
    single = np.multiply.outer(cycles.astype(np.float32), sample.astype(np.float32)).astype(np.float32)
    naive = start @ np.exp(np.complex64(2j * np.pi) * single)
    off = [float(np.abs(one - exact).max() / np.abs(exact).max()) for one in (naive, got)]
    errors(naive=off[0], ours=off[1])


def _map(values: np.ndarray, noise_power_mw: float) -> RangeAzimuthMap:
    grid = RangeAzimuthGrid()
    return example_map(values, grid=grid, noise_power_mw=noise_power_mw)


def _peak_at(ra_map: RangeAzimuthMap, cell: tuple[int, int]) -> Peaks:
    cells = np.array([cell])
    path_class = np.array([PathClass.LOS], np.uint8)
    return peaks_at(ra_map, cells, cells.astype(np.float64), np.ones(1), path_class, PeakParams())


@pytest.mark.hard("models.perception.find.peaks", "10 log10(power / noise)", 1e-12, "dB",
                  "what is nothing stands at the floor of -30 dB, to rounding")  # fmt: skip
def test_level_of_nothing_over_nothing(errors: Errors) -> None:
    """A peak of the network on an all-zero map without noise: logarithm of 0 / 0."""
    silent = _map(np.zeros((512, 256)), 0.0)
    peak = _peak_at(silent, (100, 100))
    assert np.isfinite(peak.covariance).all()
    with np.errstate(invalid="ignore", divide="ignore"):
        naive = 10.0 * np.log10(np.abs(silent.values[100, 100]) ** 2 / np.float64(silent.noise_power_mw))
    errors(naive=abs(naive + 30.0), ours=abs(peak.snr_db[0] + 30.0))


@pytest.mark.hard("models.perception.find.peaks", "parabola through the logarithms", 1e-12, "bins",
                  "symmetry: the peak lies on its bin, to rounding")  # fmt: skip
def test_peak_of_a_single_cell(errors: Errors) -> None:
    """Nothing beside it: the logarithms of its neighbours are minus infinity, and so is their difference (NaN)."""
    values = np.zeros((512, 256))
    values[100, 100] = 1e-4
    peak = _peak_at(_map(values, 0.0), (100, 100))
    with np.errstate(invalid="ignore", divide="ignore"):
        before, here, after = np.log(values[99:102, 100] ** 2)
        naive = 0.5 * (before - after) / (before - 2.0 * here + after)
    errors(naive=abs(naive), ours=abs(peak.range_m[0] / RangeAzimuthGrid().range_bin_m - 100.0))


@pytest.mark.hard("sim_player.signal.receiver", "corner over |f|", 1e-15, "",
                  "flat below what a beam resolves: corner times its duration")  # fmt: skip
def test_flicker_at_zero_frequency(errors: Errors) -> None:
    """1 / f at f = 0, the first bin of every transform. Relative error."""
    radar = _setup().radar
    exact = 1e3 * radar.beam_duration_s
    with np.errstate(divide="ignore"):
        naive = 1e3 / np.abs(np.zeros(1))
    ours = flicker_ratio(radar, np.zeros(1), 1e3)
    errors(naive=abs(naive[0] / exact - 1.0), ours=abs(ours[0] / exact - 1.0))


@pytest.mark.hard("sim_player.signal.receiver", "sin(pi f T_f) / (N sin(pi f T_c)), twice", 1e-9, "",
                  "2^-53 of 7e5 turns over a beam's start, times 2 pi")  # fmt: skip
@pytest.mark.parametrize("frequency_bins", [0.0, 40.0], ids=["at zero", "on a bin"])
def test_spur_that_repeats_with_the_chirps(frequency_bins: float, errors: Errors) -> None:
    """A whole number of turns a chirp: the sums over samples and chirps are sin(n pi) / sin(n pi). Its level."""
    radar = _setup(chirps=128).radar
    spur = Spur(frequency_hz=frequency_bins / radar.chirp_period_s, power_dbm=0.0)
    bins = range(int(frequency_bins), int(frequency_bins) + 1)
    turns = np.float64(frequency_bins)
    with np.errstate(invalid="ignore", divide="ignore"):
        chirps = np.sin(np.pi * turns * 128) / (128 * np.sin(np.pi * turns))
        samples = np.sin(np.pi * (turns - bins[0])) / (2048 * np.sin(np.pi * (turns - bins[0]) / 2048))
    errors(naive=abs(abs(chirps * samples) - 1.0), ours=abs(abs(spur_profile(radar, spur, 0.0, bins)[0]) - 1.0))


@pytest.mark.parametrize("samples", [512, 576, 1080, 1400])
def test_chirps_with_little_or_nothing_beyond_the_map(samples: int) -> None:
    """Noise is then the map's own median: right within the statistics (188 bins or more: 13 %) while it is empty."""
    setup = _setup(chirps=4, samples=samples)
    rng = np.random.default_rng(11)
    codes = np.rint(100.0 * rng.normal(size=(4, samples, 2))).astype(np.int16)
    formed = _form(setup, codes)
    expected_mw = 2e4 * setup.milliwatt_per_code_squared * 1.5 / (4 * samples) * 0.583
    assert formed.noise_power_mw == pytest.approx(expected_mw, rel=0.4, abs=0.0)


def test_odd_chirps_and_a_small_grid() -> None:
    setup = _setup(chirps=5, samples=300)
    radar = setup.radar
    beat = 1000.0 * beat_samples(radar, np.array([2.0 * 20 * radar.range_bin_m]))[0]
    samples = np.broadcast_to(np.rint(np.stack([beat.real, beat.imag], axis=-1)).astype(np.int16), (5, 300, 2))
    former = RaFormer(setup, grid=RangeAzimuthGrid(range_bins=64, azimuth_bins=5))
    beam = example_beam(stamp_ns=10**9, beam_index=12, samples=samples, full_scale_dbm=-20.0)
    former.add(beam)
    formed = former.flush()[0]
    assert formed.values.shape == (64, 5)
    assert np.abs(formed.values[:, 2]).argmax() == 20


def test_nothing_seen_of_a_vehicle_past_its_own_targets() -> None:
    """60 m/s for 0.3 s drives 18 m: cells nearer than that lie behind the last beams; answers stay finite."""
    setup = _setup()
    samples = np.random.default_rng(13).integers(-50, 50, (4, 2048, 2)).astype(np.int16)
    formed = _form(setup, samples, VehicleState(stamp_ns=0, speed_mps=60.0, yaw_rate_rps=1.0))
    assert formed.ego_compensated


@pytest.mark.parametrize("heard", [0, 1])
def test_hardly_a_beam_of_a_turning_vehicle(heard: int) -> None:
    """None but `heard` of the beams holds a signal: the map is empty or nearly so, and finite."""
    setup = _setup()
    former = RaFormer(setup)
    rng = np.random.default_rng(17)
    for index in range(25):
        samples = rng.integers(-50, 50, (4, 2048, 2)).astype(np.int16) * np.int16(index < heard)
        beam = example_beam(
            stamp_ns=index * setup.beam_interval_ns,
            beam_index=index,
            azimuth_rad=float(setup.beams.azimuth_rad[index]),
            samples=samples,
            full_scale_dbm=-20.0,
        )
        maps = former.add(beam, VehicleState(stamp_ns=0, speed_mps=5.0, yaw_rate_rps=0.5))
    assert len(maps) == 1
    assert np.isfinite(maps[0].values).all()
    assert maps[0].azimuth_stamp_ns.min() >= 0


def test_float32_fft_of_a_hundred_decibel_scene() -> None:
    """A tone at full scale and one 100 dB below, 60 bins apart: float32 and coding leave the weak one whole.

    Dithered by noise of 2 codes over 128 chirps, whose floor lies 115 dB under full scale.
    """
    setup = _setup(chirps=128)
    radar = setup.radar
    lengths_m = 2.0 * radar.range_bin_m * np.array([100.0, 160.0])
    beat = np.array([30000.0, 0.3]) @ beat_samples(radar, lengths_m)
    rng = np.random.default_rng(17)
    noise = 2.0 * rng.normal(size=(128, 2048, 2))
    samples = np.rint(np.stack([beat.real, beat.imag], axis=-1) + noise).astype(np.int16)
    former = RaFormer(setup)
    beam = example_beam(beam_index=12, samples=samples, full_scale_dbm=-20.0)
    profile = former.folder.fold(beam).profile
    weak = profile[160] / np.sqrt(setup.milliwatt_per_code_squared)
    exact = 0.3 * range_profile(radar, lengths_m[1:], 512)[0, 160]
    assert abs(weak - exact) <= 0.05


def _echoes(length_m: np.ndarray, amplitude: float) -> Paths:
    """Echoes straight ahead, all of one weight."""
    count = len(length_m)
    ahead = dict.fromkeys(("azimuth_rad", "elevation_rad"), np.zeros(count))
    ahead |= {f"departure_{name}": zeros for name, zeros in ahead.items()}
    return replace(some_paths(count, 1.0), length_m=length_m, amplitude=np.full(count, amplitude + 0j), **ahead)


STATIC = SignalEffects(mutual_coupling=True, squint=True, chirp_overlap=True, flicker=True, leakage=True)


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e12])
def test_levels_of_signal_scale(scale: float) -> None:
    """Attowatts to gigawatts: the kernel level in double precision is linear, and agrees with the beats."""
    setup = _setup(samples=512)
    lengths_m = np.linspace(0.2, 10.0, 12)
    reference = kernel_profiles(setup, _echoes(lengths_m, 1.0), STATIC, range_bins=64)
    profiles = kernel_profiles(setup, _echoes(lengths_m, scale), STATIC, range_bins=64)
    np.testing.assert_allclose(profiles / scale, reference, atol=1e-9 * np.abs(reference).max())


@pytest.mark.parametrize("share", [0.0, 1e-9, 0.5, 0.999])
def test_overlap_from_nothing_to_the_whole_chirp(share: float) -> None:
    """An echo at no range, and one that is late by nearly the chirp (all of it is then the previous chirp's)."""
    setup = _setup(samples=2048)
    path = _echoes(np.array([share * setup.radar.chirp_period_s * 299_792_458.0]), 1.0)
    beats = beam_beats(setup, path, STATIC, beams=slice(12, 13))
    literal = literal_echoes(setup, path, STATIC, beam=12)
    assert np.isfinite(beats).all()
    assert np.linalg.norm(beats - literal) <= 1e-9 * np.linalg.norm(literal)


@pytest.mark.parametrize(("samples", "chirps"), [(64, 1), (65, 1), (100, 3)])
def test_kernel_level_of_tiny_chirps(samples: int, chirps: int) -> None:
    """Fewer samples than range bins: the map wraps around like the FFT does."""
    setup = _setup(chirps=chirps, samples=samples)
    path = _echoes(np.array([4.0, 9.0]), 1.0)
    count = np.arange(samples)
    beats = beam_beats(setup, path) * (1.0 - np.cos(2.0 * np.pi * count / samples))
    expected = np.fft.fft(beats, axis=1)[:, np.arange(100) % samples] / samples
    np.testing.assert_allclose(kernel_profiles(setup, path, range_bins=100), expected, atol=1e-7)


def test_receiver_of_nothing_but_faults() -> None:
    """No echo, every fault at once, two bits: finite codes on the converter's four levels."""
    setup = _setup(chirps=2, samples=256)
    faults = FrontEnd(
        iq_gain_db=3.0,
        iq_phase_deg=20.0,
        flicker_corner_hz=1e9,
        leakage_dbm=30.0,
        adc_bits=2,
        spurs=(Spur(frequency_hz=0.0, power_dbm=-20.0), Spur(frequency_hz=-9e9, power_dbm=20.0)),
    )
    terms = beat_terms(setup, _echoes(np.zeros(0), 1.0), ALL, faults, 3)
    codes = record_beam(setup, terms, noise_bank(setup.radar, 0), [1], ALL, faults)
    assert set(np.unique(codes)) <= {-32768, -16384, 0, 16384}
