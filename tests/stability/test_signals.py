"""Hard signals: silence, one chirp, huge offsets, rails, one beam; finite answers and no warnings (they are errors)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from models.perception.ra_forming import FormingParams, RaFormer
from models.physics.waveform import beat_samples, range_profile
from msgs.radar import BeamGrid, RadarBeam, RadarParams, RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from msgs.vehicle import VehicleState
from sim_player.fmcw import noise_bank
from sim_player.front_end import FrontEnd, Spur
from sim_player.literal import literal_echoes
from sim_player.paths import Paths
from sim_player.signal_effects import ALL, SignalEffects
from sim_player.signal_levels import beam_beats, beat_terms, kernel_profiles, record_beam


def _setup(chirps: int = 4, samples: int = 2048, beams: int = 25) -> RadarSetup:
    radar = RadarParams(sample_rate_hz=1.5e9 * samples / 8192, samples_per_chirp=samples, chirps_per_beam=chirps)
    return RadarSetup(radar=radar, beams=BeamGrid(azimuth_deg=tuple(float(-60 + 5 * beam) for beam in range(beams))))


def _form(setup: RadarSetup, samples: np.ndarray, state: VehicleState | None = None, **params: Any) -> RangeAzimuthMap:
    """Every beam brings the same samples."""
    former = RaFormer(setup, FormingParams(**params))
    maps = []
    for index, azimuth_rad in enumerate(setup.beams.azimuth_rad):
        beam = RadarBeam(
            stamp_ns=index * setup.beam_interval_ns,
            scan_id=0,
            beam_index=index,
            beam_count=len(setup.beams),
            azimuth_rad=float(azimuth_rad),
            samples=samples,
            full_scale_dbm=setup.full_scale_dbm,
        )
        maps += former.add(beam, state)
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
@pytest.mark.parametrize(("chirps", "beams"), [(1, 25), (3, 1), (1, 1)])
def test_one_chirp_one_beam(mode: str, chirps: int, beams: int) -> None:
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


def test_huge_offset_beside_a_weak_echo() -> None:
    """30000 codes of offset, an echo of 3 codes, 80 dB below: window side lobes of bin 0 are gone by bin 100.

    Without a window the offset on a bin vanishes too, but a spur half a bin off leaves 1 / (pi 100) of itself, 30 dB
    over the echo.
    """
    setup = _setup(chirps=16)
    radar = setup.radar
    rng = np.random.default_rng(7)
    spur = np.exp(2j * np.pi * 0.5 * np.arange(2048) / 2048)
    echo = 3.0 * beat_samples(radar, np.array([200 * radar.range_bin_m]))[0]
    noise = rng.normal(size=(16, 2048, 2))
    beat = 30000.0 * spur + echo
    samples = np.rint(np.stack([beat.real, beat.imag], axis=-1) + noise).astype(np.int16)
    profile = {
        window: np.abs(_form(setup, samples, range_window=window).values[90:111, 128]) for window in ("hann", "none")
    }
    assert profile["hann"].argmax() == 10
    assert profile["none"][5] > 10.0 * profile["hann"][10]


@pytest.mark.parametrize("samples", [512, 576, 1080, 1400])
def test_chirps_with_little_or_nothing_beyond_the_map(samples: int) -> None:
    """Noise is then the map's own median: right within the statistics (188 bins or more: 13 %) while it is empty."""
    setup = _setup(chirps=4, samples=samples)
    rng = np.random.default_rng(11)
    codes = np.rint(100.0 * rng.normal(size=(4, samples, 2))).astype(np.int16)
    formed = _form(setup, codes)
    expected_mw = 2e4 * setup.milliwatt_per_code_squared * 1.5 / (4 * samples) * 0.583
    assert formed.noise_power_mw == pytest.approx(expected_mw, rel=0.4)


def test_odd_chirps_and_a_small_grid() -> None:
    setup = _setup(chirps=5, samples=300)
    radar = setup.radar
    beat = 1000.0 * beat_samples(radar, np.array([2.0 * 20 * radar.range_bin_m]))[0]
    samples = np.broadcast_to(np.rint(np.stack([beat.real, beat.imag], axis=-1)).astype(np.int16), (5, 300, 2))
    former = RaFormer(setup, grid=RangeAzimuthGrid(range_bins=64, azimuth_bins=5))
    beam = RadarBeam(
        stamp_ns=0, scan_id=0, beam_index=12, beam_count=25, azimuth_rad=0.0, samples=samples, full_scale_dbm=-20.0
    )
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
    beam = RadarBeam(
        stamp_ns=0, scan_id=0, beam_index=12, beam_count=25, azimuth_rad=0.0, samples=samples, full_scale_dbm=-20.0
    )
    profile, _, _ = former.folder.fold(beam)
    weak = profile[160] / np.sqrt(setup.milliwatt_per_code_squared)
    exact = 0.3 * range_profile(radar, lengths_m[1:], 512)[0, 160]
    assert abs(weak - exact) <= 0.05


def _echoes(length_m: np.ndarray, amplitude: float) -> Paths:
    """Echoes straight ahead, all of one weight."""
    count = len(length_m)
    zeros, index = np.zeros(count), np.zeros(count, np.int32)
    return Paths(
        kind=index.astype(np.uint8),
        length_m=length_m,
        radial_speed_mps=zeros,
        azimuth_rad=zeros,
        elevation_rad=zeros,
        departure_azimuth_rad=zeros,
        departure_elevation_rad=zeros,
        amplitude=np.full(count, amplitude, np.complex128),
        order=index.astype(np.uint8),
        needs=index.astype(np.uint32),
        surface=index,
        thing=index,
        point_m=np.zeros((count, 3)),
        virtual_m=np.zeros((count, 3)),
    )


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
