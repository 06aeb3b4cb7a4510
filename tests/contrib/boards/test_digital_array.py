"""Digital arrays on analytic signals and on real captures (skipped by name where the data is absent)."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from contrib.boards.digital_array import (
    DigitalArrayParams,
    form_digital_map,
    range_doppler,
    slots_aligned,
    slots_turned,
)
from msgs.values.radar import RangeAzimuthGrid
from tests.captures import DATA, needs

AWR = DATA / "awr_77ghz_openradar" / "doppler_example_1.npy"
PHASER = DATA / "xband_cn0566_fmcw" / "hex"

#: An X-band board of one summed channel whose zero range lies at 100 kHz.
PHASER_PARAMS = DigitalArrayParams(
    carrier_hz=9.9e9,
    chirp_slope_hz_per_s=500e6 / 300e-6,
    sample_rate_hz=4e6,
    chirp_interval_s=0.5e-3,
    channel_slot=(0,),
    channel_y_m=(0.0,),
    beat_offset_hz=100e3,
)


def _unwrapped(component: np.ndarray) -> np.ndarray:
    """int16 values that were stored as uint16."""
    return component.astype(np.uint16).view(np.int16).astype(np.float32)


def _target(
    params: DigitalArrayParams, bin_index: float, speed_mps: float, azimuth_rad: float, chirps: int, samples: int
) -> np.ndarray:
    """Recorded samples of a closing point of amplitude one; complex64 [chirps, channels, samples]."""
    turns_fast = (
        params.beat_offset_hz / params.sample_rate_hz * np.arange(samples) + bin_index * np.arange(samples) / samples
    )
    time_s = params.repetition_interval_s * np.arange(chirps)[:, None] + params.chirp_interval_s * np.array(
        params.channel_slot
    )
    turns_slow = -2.0 * speed_mps * time_s / params.wavelength_m
    turns_space = -np.array(params.channel_y_m) / params.wavelength_m * np.sin(azimuth_rad)
    turns = (turns_slow + turns_space)[:, :, None] + turns_fast
    return np.exp(2j * np.pi * turns).astype(np.complex64)


def _grid(params: DigitalArrayParams, samples: int, bins: int) -> RangeAzimuthGrid:
    return RangeAzimuthGrid(range_bin_m=params.range_bin_m(samples), range_bins=bins)


@pytest.mark.parametrize("speed_mps", [0.0, 2.0, -3.5])
def test_a_point_of_amplitude_one(speed_mps: float) -> None:
    """Range bin exact, azimuth within a grid step (0.47 deg), speed within a Doppler bin (0.08 m/s).

    Level: Hann scallops by at most 1.42 dB over Doppler.
    """
    params = DigitalArrayParams()
    formed = form_digital_map(
        _target(params, 40.0, speed_mps, np.radians(-24.0), 128, 128), params, _grid(params, 128, 128)
    )
    row, column = np.unravel_index(np.argmax(np.abs(formed.map.values)), formed.map.values.shape)
    assert row == 40
    assert np.degrees(formed.map.grid.azimuth_rad[column]) == pytest.approx(-24.0, abs=0.48)
    assert formed.closing_speed_mps[row, column] == pytest.approx(speed_mps, abs=0.083)
    assert -1.5 <= 20.0 * np.log10(np.abs(formed.map.values[row, column])) <= 0.01


def test_without_tdm_compensation_the_angle_errs() -> None:
    """Slots all zero: 2 m/s turns the second transmitter's channels by 1.2 rad, and the peak moves by degrees."""
    params = DigitalArrayParams()
    samples = _target(params, 40.0, 2.0, 0.0, 128, 128)
    naive = msgspec.structs.replace(params, channel_slot=(0,) * 8, chirp_interval_s=2 * params.chirp_interval_s)
    values = {
        name: form_digital_map(samples, one, _grid(params, 128, 128)).map.values[40]
        for name, one in (("ours", params), ("naive", naive))
    }
    azimuth_deg = np.degrees(_grid(params, 128, 128).azimuth_rad)
    assert abs(azimuth_deg[np.abs(values["ours"]).argmax()]) <= 0.48
    assert abs(azimuth_deg[np.abs(values["naive"]).argmax()]) >= 2.0


@pytest.mark.parametrize(("speed_bins", "tolerance"), [(0, 1e-5), (7, 1e-5), (-60, 1e-5), (7.5, 0.05), (-31.3, 0.05)])
def test_slots_are_aligned(speed_bins: float, tolerance: float) -> None:
    """Channels of the second transmitter as if it sent with the first: exact on a Doppler bin.

    Between bins, a phase step at the frame's ends stays; it is spread over all bins, and at the strongest one, under a
    Hann window over slow time, the two transmitters agree to a few percent at worst.
    """
    params = DigitalArrayParams()
    speed_mps = -speed_bins * 0.5 * params.wavelength_m / (128 * params.repetition_interval_s)
    at_once = msgspec.structs.replace(params, channel_slot=(0,) * 8, chirp_interval_s=2 * params.chirp_interval_s)
    aligned = slots_aligned(_target(params, 40.0, speed_mps, 0.3, 128, 128), params)
    ours = range_doppler(aligned, at_once)[..., 40]
    truth = range_doppler(_target(at_once, 40.0, speed_mps, 0.3, 128, 128), at_once)[..., 40]
    peak = np.abs(truth).sum(axis=1).argmax()
    assert np.abs(ours[peak] / truth[peak] - 1.0).max() <= tolerance
    if tolerance < 0.01:
        np.testing.assert_allclose(ours, truth, atol=1e-5)


def test_a_known_speed_turns_single_chirps() -> None:
    """One chirp of each transmitter shows no Doppler: with the speed given, channels are those of one slot, exactly.

    Left as they are, 2 m/s at 92 us stand 4 pi 92e-6 2 / 3.8 mm = 35 deg apart, a step in the middle of the row.
    """
    params = DigitalArrayParams()
    samples = _target(params, 40.0, 2.0, 0.3, 1, 128)
    at_once = _target(msgspec.structs.replace(params, channel_slot=(0,) * 8), 40.0, 2.0, 0.3, 1, 128)
    np.testing.assert_allclose(slots_turned(samples, params, 2.0), at_once, atol=1e-5)
    step_deg = np.degrees(np.angle(samples[0, 4, 0] / at_once[0, 4, 0]))
    assert step_deg == pytest.approx(-34.9, abs=0.1)
    np.testing.assert_array_equal(slots_aligned(samples, params), samples)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_three_transmitters_in_any_order(order: tuple[int, ...]) -> None:
    """Phases at the peak are those of the direction alone, whichever slot each transmitter has; 3.1 of +-3.4 m/s.

    Analytic: -k y sin(azimuth); tolerance 0.01 rad, of complex64.
    """
    wavelength_m = DigitalArrayParams().wavelength_m
    places = tuple(0.5 * wavelength_m * (4 * transmitter + receiver) for transmitter in order for receiver in range(4))
    params = DigitalArrayParams(channel_slot=tuple(slot for slot in range(3) for _ in range(4)), channel_y_m=places)
    speed_mps = 0.5 * wavelength_m * 29 / (64 * params.repetition_interval_s)
    spectra = range_doppler(_target(params, 30.0, speed_mps, -0.4, 64, 128), params)[..., 30]
    peak = spectra[np.abs(spectra).sum(axis=1).argmax()]
    turns = -(np.array(places) - places[0]) / wavelength_m * np.sin(-0.4)
    assert np.abs(np.angle(peak * peak[0].conj() * np.exp(-2j * np.pi * turns))).max() <= 0.01


def test_static_removal_keeps_movers() -> None:
    params = DigitalArrayParams(remove_static=True)
    wall = 100.0 * _target(params, 20.0, 0.0, 0.1, 64, 128)
    mover = _target(params, 20.0, 1.5, -0.2, 64, 128)
    formed = form_digital_map((wall + mover).astype(np.complex64), params, _grid(params, 128, 128))
    column = np.abs(formed.map.values[20]).argmax()
    assert formed.map.grid.azimuth_rad[column] == pytest.approx(-0.2, abs=0.02)
    assert formed.closing_speed_mps[20, column] == pytest.approx(1.5, abs=0.1)


def test_noise_figure_is_that_of_single_cells() -> None:
    """White noise of power 1 over 64 x 128 values, windowed twice: 2.25 / 8192 / 8 channels; median of 65536 cells."""
    rng = np.random.default_rng(5)
    noise = ((rng.normal(size=(64, 8, 128)) + 1j * rng.normal(size=(64, 8, 128))) / np.sqrt(2.0)).astype(np.complex64)
    params = DigitalArrayParams()
    formed = form_digital_map(noise, params, _grid(params, 128, 128))
    assert formed.map.noise_power_mw == pytest.approx(2.25 / 8192 / 8, rel=0.03)


def test_conjugate_hardware_and_offset_beat() -> None:
    params = msgspec.structs.replace(PHASER_PARAMS, beat_sign=-1)
    samples = _target(PHASER_PARAMS, 18.0, -1.0, 0.0, 32, 1024).conj()
    spectra = range_doppler(np.ascontiguousarray(samples), params)
    doppler, _, row = np.unravel_index(np.argmax(np.abs(spectra)), spectra.shape)
    assert row == 18
    assert params.closing_speed_mps(32)[doppler] == pytest.approx(-1.0, abs=0.48)


def test_one_chirp_and_silence_stay_finite() -> None:
    params = DigitalArrayParams(remove_static=True)
    formed = form_digital_map(np.zeros((1, 8, 128), np.complex64), params, _grid(params, 128, 64))
    assert not formed.map.values.any()
    assert formed.map.noise_power_mw == 0.0


def test_wrong_shapes_and_grids_are_refused() -> None:
    params = DigitalArrayParams()
    with pytest.raises(ValueError, match=r"samples must have shape \?x8x\?, got \(4, 7, 128\)"):
        range_doppler(np.zeros((4, 7, 128), np.complex64), params)
    with pytest.raises(ValueError, match="at least one chirp"):
        range_doppler(np.zeros((0, 8, 128), np.complex64), params)
    with pytest.raises(ValueError, match="grid must have at most 128 range bins"):
        form_digital_map(np.zeros((4, 8, 128), np.complex64), params, RangeAzimuthGrid())
    with pytest.raises(ValueError, match="must name the same channels, got 2 and 8"):
        DigitalArrayParams(channel_slot=(0, 1))


@needs(AWR)
def test_real_77_ghz_capture() -> None:
    """Indoor capture of a slow mover: 2.93 m (bin 60), 0.58 m/s, 6.5 deg off boresight as channel phases tell.

    One receiver is 15 deg off the phase front, so the angle is good to about a degree; the side is not documented.
    """
    raw = np.load(AWR)
    samples = (_unwrapped(raw.real) + 1j * _unwrapped(raw.imag)).astype(np.complex64)
    params = DigitalArrayParams(remove_static=True)
    formed = form_digital_map(samples, params, _grid(params, 128, 128))
    # the first metre is the transmitter's own leakage
    values = np.abs(formed.map.values[20:])
    row, column = np.unravel_index(np.argmax(values), values.shape)
    assert row + 20 == 60
    assert formed.map.grid.range_m[row + 20] == pytest.approx(2.93, abs=0.03)
    assert abs(formed.closing_speed_mps[row + 20, column]) == pytest.approx(0.58, abs=0.05)
    assert abs(np.degrees(formed.map.grid.azimuth_rad[column])) == pytest.approx(6.5, abs=1.0)


@needs(AWR)
def test_real_channels_without_their_slots() -> None:
    """The mover's documented phases, 20.5 deg an element once 9.8 deg of its Doppler between slots are taken off.

    Doppler bin 7 of 128, slots half a repetition apart: 7 / 128 * 180 = 9.84 deg. One receiver is 15 deg off the phase
    front, so that the line through 8 channels is good to 1 deg an element.
    """
    raw = np.load(AWR)
    samples = (_unwrapped(raw.real) + 1j * _unwrapped(raw.imag)).astype(np.complex64)
    documented_deg = np.array([0, 24, 50, 57, 96, 120, 146, 152])
    params = DigitalArrayParams(remove_static=True)
    at_once = msgspec.structs.replace(params, channel_slot=(0,) * 8, chirp_interval_s=2 * params.chirp_interval_s)
    before, after = (range_doppler(samples, each)[7, :, 60] for each in (at_once, params))
    before_deg, after_deg = (np.degrees(np.unwrap(np.angle(each / each[0]))) for each in (before, after))
    np.testing.assert_allclose(before_deg, documented_deg, atol=2.0)
    np.testing.assert_allclose(before_deg - after_deg, [0.0] * 4 + [9.84] * 4, atol=0.05)
    assert np.polyfit(np.arange(8), after_deg, 1)[0] == pytest.approx(20.5, abs=1.0)


@needs(PHASER)
def test_real_x_band_burst() -> None:
    """One summed channel, 32 chirps: the strongest return stands still at 6.5 m.

    Bins are 0.35 m; a parabola through the logarithms about the peak is good to a tenth of a bin under a Hann window.
    """
    words = [
        np.array([int(word, 16) for word in (PHASER / f"post_ddc_{part}.hex").read_text().split()], np.uint16)
        for part in "iq"
    ]
    samples = (words[0].view(np.int16) + 1j * words[1].view(np.int16)).astype(np.complex64).reshape(32, 1, 1024)
    formed = form_digital_map(samples, PHASER_PARAMS, _grid(PHASER_PARAMS, 1024, 400))
    level = np.log(np.abs(formed.map.values[:, 0]))
    row = int(level.argmax())
    left, peak, right = level[row - 1 : row + 2]
    offset = 0.5 * (left - right) / (left - 2.0 * peak + right)
    assert formed.map.grid.range_at(row + offset) == pytest.approx(6.5, abs=0.05)
    assert abs(formed.closing_speed_mps[row, 0]) <= 0.48
