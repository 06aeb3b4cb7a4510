"""Profiles of slow-time sums: those that the former makes of all chirps, moved along range, with faults and noise."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from lab.tradeoff.literal_signal import literal_echoes
from models.perception.form.ra_forming import BeamFolder, FormingParams, ego_correction
from models.perception.form.slow_time_sums import group_edges
from msgs.values.radar import RadarSetup, RangeAzimuthGrid
from msgs.values.units import SPEED_OF_LIGHT_MPS
from msgs.values.vehicle import VehicleState
from sim_player.dataset.labelled_scan import noise_power_mw
from sim_player.scene.front_end import FrontEnd, Spur
from sim_player.signal.levels import RANGE_BINS, echo_terms, with_electronics
from sim_player.signal.slow_time_profiles import converter_objection, group_noise, group_profiles
from sim_player.signal.switches import IDEAL, PLAIN, SignalEffects
from tests.builders import example_beam
from tests.sim_player.signal.references import ALL, received_samples
from tests.sim_player.signal.test_levels import FAULTS, SMALL, apart, some_paths

BEAM = 9
#: Eight groups of four chirps of the full length.
SHORT = msgspec.structs.replace(
    RadarSetup(), radar=msgspec.structs.replace(RadarSetup().radar, chirps_per_beam=32, samples_per_chirp=2048)
)
EDGES = group_edges(32, 8)
NOISELESS = msgspec.structs.replace(ALL, thermal_noise=False, flicker=False, adc=False)


def profiles_of(samples: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """What the former has of chirps [chirps, samples] in double precision, [groups, 512]."""
    sums = np.add.reduceat(samples, edges[:-1], axis=0) / edges[-1]
    count = samples.shape[1]
    window = 1.0 - np.cos(2.0 * np.pi * np.arange(count) / count)
    return np.asarray(np.fft.fft(sums * window, axis=1)[:, :RANGE_BINS] / count)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize(
    "effects", [IDEAL, PLAIN, SignalEffects(range_migration=True), NOISELESS], ids=["rest", "plain", "migration", "all"]
)
def test_profiles_are_those_of_all_chirps(effects: SignalEffects, precision: str) -> None:
    """Six echoes at up to 40 m/s against the literal level: slow-time terms to 1e-5, single precision to 1e-4."""
    setup = RadarSetup(radar=msgspec.structs.replace(SHORT.radar, samples_per_chirp=2048, chirps_per_beam=8))
    edges = group_edges(8, 4)
    effects = msgspec.structs.replace(effects, iq_imbalance=False, leakage=False, spurs=False)
    paths = some_paths(6, 30.0, two_ways=True, speed_mps=40.0)
    terms = echo_terms(setup, paths, effects, FAULTS, BEAM, precision)
    literal = literal_echoes(setup, paths, effects, FAULTS, BEAM, range(8))
    limit = 3e-5 if precision == "float64" else 1e-4
    assert apart(group_profiles(setup, terms, edges, effects, FAULTS), profiles_of(literal, edges)) < limit


def test_a_plain_mean_is_blind_at_21_mps() -> None:
    """One echo at lambda / (2 T_f) = 21.4 m/s: the groups cancel in their sum, and the former finds it all the same.

    The loss of eight sums at their own Doppler is 0.22 dB (sin(pi / 8) / (pi / 8)); scalloping none, it lies on a bin.
    """
    setup = RadarSetup()
    speed_mps = setup.radar.wavelength_m / (2.0 * setup.radar.beam_duration_s)
    moving, resting = some_paths(1, 30.0, speed_mps=0.0), some_paths(1, 30.0, speed_mps=0.0)
    moving.radial_speed_mps[:] = speed_mps
    folder = BeamFolder(setup, FormingParams(), RangeAzimuthGrid())
    got, rest = (
        group_profiles(setup, echo_terms(setup, paths, PLAIN, beam=BEAM, precision="float64"), folder.group_edges)
        for paths in (moving, resting)
    )
    level = np.abs(rest.sum(axis=0)).max()
    assert np.abs(got.sum(axis=0)).max() < 1e-4 * level
    found = np.abs(folder.resolved(got.astype(np.complex64), 1e-30)[0]).max()
    assert 20.0 * np.log10(found / level) == pytest.approx(-0.22, abs=0.02)


def test_profiles_through_the_former_are_its_own() -> None:
    """Codes of a beam with faults, electronics and spurs, conjugated, folded by the former with the vehicle's motion.

    Codes are rounded: against a converter whose full scale is 20 dB over the beam's peak, 1e-4 of the strongest cell.
    """
    front_end = msgspec.structs.replace(FAULTS, leakage_dbm=-70.0, spurs=(Spur(frequency_hz=5e6, power_dbm=-100.0),))
    setup = msgspec.structs.replace(SHORT, beat_sign=-1)
    terms = echo_terms(setup, some_paths(40, 60.0, speed_mps=15.0), NOISELESS, front_end, BEAM, "float32")
    terms = with_electronics(setup, terms, NOISELESS, front_end, [1])
    samples = received_samples(setup, terms, np.zeros((2, 1)), [0], NOISELESS, front_end)
    folder = BeamFolder(setup, FormingParams(), RangeAzimuthGrid())
    ego = ego_correction(folder, BEAM, 0.1, VehicleState(stamp_ns=0, speed_mps=12.0, yaw_rate_rps=0.2))
    peak = np.abs(samples).max()
    codes = np.rint(np.stack([samples.real, samples.imag], axis=-1) * (3276.8 / peak)).astype(np.int16)
    beam = example_beam(beam_index=BEAM, samples=codes, full_scale_dbm=float(20.0 * np.log10(10.0 * peak)))
    wanted, noise_power_mw, *_ = folder.fold(beam, ego)
    profiles = group_profiles(setup, terms, folder.group_edges, NOISELESS, front_end, ego.sample_phase)
    got = folder.resolved(profiles, noise_power_mw, ego)[0] * ego.bin_phase
    assert np.abs(got - wanted).max() < 1e-4 * np.abs(wanted).max()


def test_noise_has_the_power_and_the_correlation_of_sums() -> None:
    """60 draws of 8 x 512 bins: each group an eighth of the beam's noise, to 1 %; groups do not correlate. A beam cut
    to half its chirps has twice the noise.
    """
    setup, ideal = RadarSetup(), SignalEffects(adc=False)
    noise = np.stack([group_noise(setup, group_edges(128, 8), [7, draw], ideal) for draw in range(60)])
    noise = noise / np.sqrt(noise_power_mw(setup))
    assert np.mean(np.abs(noise) ** 2) == pytest.approx(1.0 / 8.0, rel=0.02)
    assert np.mean(np.abs(noise.sum(axis=1)) ** 2) == pytest.approx(1.0, rel=0.02)
    assert abs(np.mean(noise[:, 0] * np.conj(noise[:, 1]))) < 0.01 / 8.0
    half = np.stack([group_noise(setup, group_edges(64, 8), [7, draw], ideal) for draw in range(60)])
    assert np.mean(np.abs(half.sum(axis=1)) ** 2) / noise_power_mw(setup) == pytest.approx(2.0, rel=0.02)


def test_flicker_lies_where_range_and_doppler_say() -> None:
    """1/f noise of 5 MHz, moved along range by 100 bins: strongest there, and along with its Doppler bins 1/f."""
    front_end, effects = FrontEnd(flicker_corner_hz=5e6), SignalEffects(flicker=True, adc=False)
    draws = [
        group_noise(RadarSetup(), group_edges(128, 8), [1, draw], effects, front_end, 100.0) for draw in range(200)
    ]
    power = np.mean(np.abs(np.fft.fft(np.stack(draws), axis=1)) ** 2, axis=0)
    assert np.argmax(power.sum(axis=0)) == 100
    # Doppler 0 has 1 / T_f as its floor, Doppler 4 a quarter of it
    assert power[0, 100] / power[4, 100] == pytest.approx(4.0, rel=0.5)


def test_a_converter_that_clips_is_named() -> None:
    """A beam under full scale, and the same forty times as strong; too little dither for coarse codes."""
    setup = SMALL
    full_scale = 32768.0 * np.sqrt(setup.milliwatt_per_code_squared)
    terms = echo_terms(setup, some_paths(30, 3.0, speed_mps=10.0), PLAIN, beam=BEAM, precision="float32")
    beats, carrier, basis = terms
    peak = np.abs((carrier * basis).T @ beats).max()
    soft, loud = ((beats * (level * full_scale / peak), carrier, basis) for level in (0.5, 1.5))
    assert converter_objection(setup, soft, PLAIN) is None
    assert "the converter clips" in (converter_objection(setup, loud, PLAIN) or "")
    assert "rounding is white only" in (converter_objection(setup, soft, PLAIN, FrontEnd(adc_bits=8)) or "")


def test_the_beam_s_range_shift_is_the_vehicle_s_way() -> None:
    """10 m/s straight ahead, 0.2 s: the beam ahead moves by 2 m, that is 2 B / c bins a metre."""
    folder = BeamFolder(RadarSetup(), FormingParams(), RangeAzimuthGrid())
    ego = ego_correction(folder, 12, 0.2, VehicleState(stamp_ns=0, speed_mps=10.0))
    assert ego.shift_m == pytest.approx(2.0, rel=1e-9)
    turns = np.angle(ego.sample_phase[1]) / (2.0 * np.pi) * 8192
    assert turns == pytest.approx(2.0 * 2.0 * 700e6 / SPEED_OF_LIGHT_MPS, rel=1e-3)
