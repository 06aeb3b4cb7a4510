"""Kernel, beat and literal level: one answer, with every effect alone and all together; each effect against its law."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from lab.tradeoff.literal_signal import literal_echoes
from models.physics.antenna import element_field, one_way_pattern, setup_weights, steering_weights
from models.physics.waveform import beat_samples
from msgs.values.radar import ArrayParams, BeamGrid, RadarParams, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.dataset.labelled_scan import clean_profiles, profile_noise
from sim_player.scene.front_end import FrontEnd, Spur
from sim_player.signal.fmcw import beam_weights, noise_bank
from sim_player.signal.levels import (
    beam_beats,
    echo_profiles,
    group_beats,
    kernel_objections,
    kernel_profiles,
    noise_profiles,
    noise_rms,
    record_beam,
)
from sim_player.signal.swept_echoes import cardinal_functions, chebyshev_instants, squint_swing_rad, swept_echoes
from sim_player.signal.switches import IDEAL, PLAIN, SignalEffects, sweep_ratio
from sim_player.trace.path_table import Paths
from tests.sim_player.signal.references import ALL, beat_terms, received_samples

FAULTS = FrontEnd(coupling_db=-18.0, coupling_phase_deg=40.0, iq_gain_db=0.5, iq_phase_deg=3.0)
STATIC = SignalEffects(mutual_coupling=True, squint=True, chirp_overlap=True)
#: A short chirp of the same band: overlap of 13 % is reached at 6.9 m.
SMALL = RadarSetup(radar=RadarParams(samples_per_chirp=512, chirps_per_beam=4))
OVERLAP = 2.0 * 109.42 / SPEED_OF_LIGHT_MPS / RadarParams().chirp_period_s


def louder(paths: Paths, factor: float) -> Paths:
    return replace(paths, amplitude=paths.amplitude * factor)


def some_paths(count: int, longest_m: float, seed: int = 0, two_ways: bool = False, speed_mps: float = 0.0) -> Paths:
    """Random echoes all around and a little up and down."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-1.5, 1.5, count), rng.uniform(-0.3, 0.3, count)
    out = (rng.uniform(-1.5, 1.5, count), rng.uniform(-0.3, 0.3, count)) if two_ways else (azimuth, elevation)
    nothing = np.zeros(count, np.int32)
    return Paths(
        kind=nothing.astype(np.uint8),
        length_m=rng.uniform(0.1, longest_m, count),
        radial_speed_mps=rng.uniform(-speed_mps, speed_mps, count),
        azimuth_rad=azimuth,
        elevation_rad=elevation,
        departure_azimuth_rad=out[0],
        departure_elevation_rad=out[1],
        amplitude=1e-6 * (rng.normal(size=count) + 1j * rng.normal(size=count)),
        order=nothing.astype(np.uint8),
        needs=nothing.astype(np.uint32),
        surface=nothing,
        object_index=nothing,
        chain=np.arange(count, dtype=np.uint64),
        point_m=np.zeros((count, 3)),
        virtual_m=np.zeros((count, 3)),
    )


def one_path(length_m: float, azimuth_deg: float = 0.0, speed_mps: float = 0.0) -> Paths:
    path = some_paths(1, 1.0)
    azimuth, level = np.radians([azimuth_deg]), np.zeros(1)
    return replace(
        path,
        length_m=np.array([length_m]),
        radial_speed_mps=np.array([speed_mps]),
        azimuth_rad=azimuth,
        departure_azimuth_rad=azimuth,
        elevation_rad=level,
        departure_elevation_rad=level,
        amplitude=np.ones(1, np.complex128),
    )


def chirp_span_m(setup: RadarSetup, share: float) -> float:
    """Round trip whose echo is late by a share of the chirp."""
    return share * setup.radar.chirp_period_s * SPEED_OF_LIGHT_MPS


def hann_profiles(beats: np.ndarray, bins: int) -> np.ndarray:
    count = beats.shape[-1]
    return np.fft.fft(beats * (1.0 - np.cos(2.0 * np.pi * np.arange(count) / count)))[..., :bins] / count


def apart(got: np.ndarray, reference: np.ndarray) -> float:
    """Relative L2 distance."""
    return float(np.linalg.norm(got - reference) / np.linalg.norm(reference))


# --- three levels


@pytest.mark.parametrize("two_ways", [False, True])
@pytest.mark.parametrize(
    "effects",
    [
        IDEAL,
        PLAIN,
        SignalEffects(element_pattern=False),
        SignalEffects(quantised_phases=False),
        SignalEffects(mutual_coupling=True),
        SignalEffects(squint=True),
        SignalEffects(chirp_overlap=True),
        STATIC,
    ],
    ids=["ideal", "plain", "isotropic", "exact phases", "coupling", "squint", "overlap", "all"],
)
def test_three_levels_one_answer(effects: SignalEffects, two_ways: bool) -> None:
    """30 echoes up to 13 % of the chirp, beams -60 and 0 deg. Reference: literal, float64.

    Bias: f_c t of 3e3 turns rounds to 1e-12; gridding 1e-10. Tolerances are the levels' own: 1e-9, and 1e-4 in
    float32.
    """
    paths = some_paths(30, chirp_span_m(SMALL, OVERLAP), two_ways=two_ways)
    beats = beam_beats(SMALL, paths, effects, FAULTS)
    double = kernel_profiles(SMALL, paths, effects, FAULTS, 60)
    single = kernel_profiles(SMALL, paths, effects, FAULTS, 60, "float32")
    quick = group_beats(SMALL, [(paths, effects)], FAULTS, precision="float32")
    assert (double.dtype, single.dtype, quick.dtype) == (np.complex128, np.complex64, np.complex64)
    for beam in (0, 12):
        literal = literal_echoes(SMALL, paths, effects, FAULTS, beam)[0]
        assert apart(beats[beam], literal) < 1e-9
        assert apart(quick[beam], literal) < 1e-4
        assert apart(double[beam], hann_profiles(literal, 60)) < 1e-9
        assert apart(single[beam], hann_profiles(literal, 60)) < 1e-4


@pytest.mark.parametrize("carrier_hz", [10e9, 77e9])
def test_three_levels_on_the_full_chirp(carrier_hz: float) -> None:
    """8192 samples, echoes to 109 m, X-band 4 x 8 and 77 GHz 1 x 57, everything static on, beam 60 deg.

    At 77 GHz f_c t is 4e5 turns: 3e-10 rad of rounding in the literal chirps; tolerance 1e-9.
    """
    array = ArrayParams() if carrier_hz < 20e9 else ArrayParams(columns=57, rows=1)
    setup = RadarSetup(radar=RadarParams(carrier_hz=carrier_hz), array=array, beams=BeamGrid(azimuth_deg=(60.0,)))
    paths = some_paths(12, 2 * 109.42, seed=3, two_ways=True)
    literal = literal_echoes(setup, paths, STATIC, FAULTS)
    assert apart(beam_beats(setup, paths, STATIC, FAULTS), literal) < 1e-9
    reference = hann_profiles(literal, 512)
    assert apart(kernel_profiles(setup, paths, STATIC, FAULTS), reference) < 1e-9
    assert apart(kernel_profiles(setup, paths, STATIC, FAULTS, precision="float32"), reference) < 1e-4


@pytest.mark.parametrize("name", ["element_pattern", "quantised_phases", "mutual_coupling", "squint", "chirp_overlap"])
def test_every_switch_changes_the_signal(name: str) -> None:
    """The least, six-bit phases, are worth some 3 % of the field; agreement above cannot come from idle switches."""
    paths = some_paths(30, chirp_span_m(SMALL, OVERLAP))
    off = msgspec.structs.replace(STATIC, **{name: False})
    on = literal_echoes(SMALL, paths, STATIC, FAULTS, 3)
    assert apart(literal_echoes(SMALL, paths, off, FAULTS, 3), on) > 5e-3


def test_plain_effects_are_the_plain_chain() -> None:
    """Kernel: `clean_profiles`; beats: closed form; noise draws: `profile_noise` where nothing is rounded."""
    setup, paths = RadarSetup(), some_paths(300, 2 * 109.0)
    assert apart(kernel_profiles(setup, paths), clean_profiles(setup, paths)) < 1e-10
    plain = beam_weights(setup, paths) @ beat_samples(setup.radar, paths.length_m)
    assert apart(beam_beats(setup, paths), plain) < 1e-10
    no_rounding = SignalEffects(adc=False)
    np.testing.assert_array_equal(noise_profiles(setup, 5, no_rounding), profile_noise(setup, 5))


def test_a_fault_that_the_board_does_not_have_changes_no_code() -> None:
    """Switches of flicker and imbalance over a front end without either, and an imbalance that is not simulated: the
    plain codes to the bit, up to full scale.

    Another order of float32 sums would move some of the 8192 codes of up to 2^15 by one.
    """
    radar = RadarParams(samples_per_chirp=512, chirps_per_beam=8)
    setup = RadarSetup(radar=radar)
    terms = beat_terms(setup, louder(some_paths(40, 6.0, speed_mps=20.0), 500.0), beam=7)
    bank = noise_bank(radar, 1)
    plain = record_beam(setup, terms, bank, [1, 2])
    assert np.abs(plain.astype(int)).max() > 20_000
    switched = record_beam(setup, terms, bank, [1, 2], SignalEffects(flicker=True, iq_imbalance=True), FrontEnd())
    np.testing.assert_array_equal(switched, plain)
    left_out = record_beam(setup, terms, bank, [1, 2], SignalEffects(iq_imbalance=False), FrontEnd(iq_gain_db=0.5))
    np.testing.assert_array_equal(left_out, plain)


@pytest.mark.parametrize("beat_sign", [1, -1])
def test_codes_of_a_faulty_receiver(beat_sign: int) -> None:
    """Echoes, leakage, a spur, thermal and 1/f noise, imbalance and 12 bits: the codes of samples in double precision.

    Ties of float32 sums of up to 300 steps fall a step apart, in under 1 in 1,000.
    """
    setup = msgspec.structs.replace(SMALL, beat_sign=beat_sign)
    spurs = (Spur(frequency_hz=60.1e6, power_dbm=-70.0),)
    faults = msgspec.structs.replace(FAULTS, leakage_dbm=-60.0, spurs=spurs, flicker_corner_hz=2e5, adc_bits=12)
    terms = beat_terms(setup, louder(some_paths(40, 6.0, speed_mps=20.0), 100.0), ALL, faults, 7)
    bank = noise_bank(setup.radar, 1)
    samples = received_samples(setup, terms, bank, [1, 2], ALL, faults) / np.sqrt(setup.milliwatt_per_code_squared)
    expected = np.clip(np.rint(np.stack([samples.real, samples.imag], axis=-1) / 16), -2048, 2047) * 16
    got = record_beam(setup, terms, bank, [1, 2], ALL, faults)
    assert np.abs(got - expected).max() <= 16
    assert np.mean(got != expected) < 1e-3
    assert np.abs(expected).max() > 1000


def test_no_paths_and_far_paths() -> None:
    setup = RadarSetup()
    assert not kernel_profiles(setup, some_paths(0, 1.0), STATIC, FAULTS).any()
    assert not beam_beats(SMALL, some_paths(0, 1.0), STATIC, FAULTS).any()
    far = some_paths(5, 1000.0, seed=4)
    assert apart(kernel_profiles(setup, far), clean_profiles(setup, far)) < 1e-9 * 1e3


# --- antenna


def test_isotropic_elements_have_the_peak_gain_in_front() -> None:
    """One column, one row at 80 deg: field 10^(2 x 4.1 / 20) with the switch off, 25 dB twice below with it on."""
    setup = RadarSetup(radar=SMALL.radar, array=ArrayParams(columns=1, rows=1), beams=BeamGrid(azimuth_deg=(0.0,)))
    path = one_path(3.0, 80.0)
    gain = 10.0 ** (2 * 4.1 / 20.0)
    assert np.abs(beam_beats(setup, path, IDEAL)).max() == pytest.approx(gain, rel=1e-9)
    on = np.abs(beam_beats(setup, path, PLAIN)).max()
    assert on == pytest.approx(element_field(setup.element, path.azimuth_rad, np.zeros(1))[0] ** 2, rel=1e-9)
    assert not beam_beats(setup, one_path(3.0, 120.0), IDEAL).any()


def test_exact_phases_are_those_of_the_steering_angle() -> None:
    """Steered and seen at 35 deg: all 8 columns in phase, two-way field 32 x element; 6 bits lose a little."""
    setup = RadarSetup(radar=SMALL.radar, beams=BeamGrid(azimuth_deg=(35.0,)))
    path = one_path(3.0, 35.0)
    best = 32.0 * 10.0 ** (2 * 4.1 / 20.0)
    ideal = np.abs(beam_beats(setup, path, IDEAL)).max()
    stepped = np.abs(beam_beats(setup, path, msgspec.structs.replace(IDEAL, quantised_phases=True))).max()
    assert ideal == pytest.approx(best, rel=1e-9)
    # phase errors within +-2.8 deg: the mean cosine is at least 0.9988 one way
    assert 0.9988**2 * best < stepped < 0.99999 * best


def test_squint_follows_the_sweep() -> None:
    """Echo at 56.5 deg in the beam at 60: |beat(t)| is the pattern at f_c + S (t - tau) - B / 2, sample by sample.

    sin(a) = sin(60) f_c / f points the beam at 56.8 deg at the sweep's upper end and 63.8 deg at its lower (+-3.5 deg):
    the echo grows along the chirp.
    """
    setup = RadarSetup(beams=BeamGrid(azimuth_deg=(60.0,)))
    path = one_path(40.0, 56.5)
    squint = msgspec.structs.replace(IDEAL, squint=True)
    envelope = np.abs(beam_beats(setup, path, squint)[0])
    exact = np.zeros(3)
    weights = steering_weights(ArrayParams(phase_bits=0), setup.radar.wavelength_m, np.radians([60.0]))
    for index, sample in enumerate((0, 4000, 8191)):
        ratio = sweep_ratio(setup.radar, np.array(sample / 1.5e9 - 40.0 / SPEED_OF_LIGHT_MPS))
        phases = np.pi * ratio * np.sin(path.azimuth_rad[0]) * (np.arange(8) - 3.5)
        exact[index] = 4.0 / 8.0 * np.abs(np.sum(weights * np.exp(1j * phases))) ** 2 * 10.0 ** (2 * 4.1 / 20.0)
    np.testing.assert_allclose(envelope[[0, 4000, 8191]], exact, rtol=1e-8)
    assert envelope[8191] > 1.2 * envelope[0]


def test_band_edges_point_three_and_a_half_degrees_away() -> None:
    """sin(a) = sin(60) / (1 +- 0.035): 56.8 and 63.8 deg; maximum of the one-way array factor within 0.1 deg."""
    setup = RadarSetup(beams=BeamGrid(azimuth_deg=(60.0,)))
    radar = setup.radar
    edges = sweep_ratio(radar, np.array([0.0, radar.chirp_period_s]))
    np.testing.assert_allclose(edges, [0.965, 1.035], rtol=1e-12)
    azimuth = np.radians(np.linspace(50.0, 70.0, 2001))
    weights = steering_weights(ArrayParams(phase_bits=0), radar.wavelength_m, np.radians([60.0]))
    flat = msgspec.structs.replace(
        setup, element=msgspec.structs.replace(setup.element, azimuth_hpbw_deg=1e9, elevation_hpbw_deg=1e9)
    )
    for ratio, expected_deg in zip(edges, (63.82, 56.80), strict=True):
        pattern = np.abs(one_way_pattern(flat, weights, azimuth, np.zeros(2001), ratio))[0]
        assert np.degrees(azimuth[pattern.argmax()]) == pytest.approx(expected_deg, abs=0.1)


@pytest.mark.parametrize(("tolerance", "most"), [(1e-5, 7), (1e-11, 12)])
def test_few_instants_hold_the_squint(tolerance: float, most: int) -> None:
    """Worst direction of the X-band array: alpha = 2 x 3.5 pi x 0.035 plus the rows; error of exp(j alpha x)."""
    swing = squint_swing_rad(RadarSetup(), some_paths(200, 10.0))
    instants = chebyshev_instants(swing, tolerance)
    share = np.linspace(0.0, 1.0, 501)
    exact = np.exp(1j * swing * (2.0 * share - 1.0))
    got = np.exp(1j * swing * (2.0 * instants - 1.0)) @ cardinal_functions(instants, share)
    assert np.abs(got - exact).max() < tolerance
    assert len(instants) <= most


# --- waveform


def test_overlap_takes_the_start_of_the_chirp() -> None:
    """An echo on bin 511, 13 % late: its bin keeps the window's share after tau, (1/N) sum_{n >= tau f_s} (1 - cos).

    1 - 0.134 + sin(2 pi 0.134) / 2 pi = 0.985. The tail adds an edge 3311 bins away: under 1e-4.
    """
    setup = RadarSetup(beams=BeamGrid(azimuth_deg=(0.0,)))
    path = one_path(2.0 * 511 * setup.radar.range_bin_m)
    late = OVERLAP
    on, off = (
        np.abs(kernel_profiles(setup, path, msgspec.structs.replace(IDEAL, chirp_overlap=overlap)))[0, 511]
        for overlap in (True, False)
    )
    expected = 1.0 - late + np.sin(2.0 * np.pi * late) / (2.0 * np.pi)
    assert expected == pytest.approx(0.985, abs=0.001)
    assert on / off == pytest.approx(expected, abs=2e-4)


def test_tail_is_the_previous_chirp_s_tone() -> None:
    """In the first tau seconds the frequency is S tau - B (complex sampling at 1.5 GHz takes -700 MHz as it is)."""
    radar = SMALL.radar
    path = one_path(chirp_span_m(SMALL, OVERLAP))
    beats = beam_beats(SMALL, path, msgspec.structs.replace(IDEAL, chirp_overlap=True), beams=slice(12, 13))[0]
    turn = np.angle(beats[1:] / beats[:-1]) / (2.0 * np.pi) * radar.sample_rate_hz
    ends = int(np.ceil(OVERLAP * 512))
    np.testing.assert_allclose(turn[: ends - 1], (OVERLAP - 1.0) * radar.bandwidth_hz, rtol=1e-7)
    np.testing.assert_allclose(turn[ends:], OVERLAP * radar.bandwidth_hz, rtol=1e-7)


def test_the_converter_s_filter_takes_a_tail_beyond_half_its_rate() -> None:
    """At f_s = 1 GHz the tail near -610 MHz lies outside +-500 MHz: nothing is heard in the first tau seconds."""
    setup = RadarSetup(radar=RadarParams(samples_per_chirp=512, sample_rate_hz=1e9, chirps_per_beam=1))
    path = one_path(chirp_span_m(setup, OVERLAP))
    effects = msgspec.structs.replace(IDEAL, chirp_overlap=True)
    for beats in (beam_beats(setup, path, effects)[12], literal_echoes(setup, path, effects, beam=12)[0]):
        ends = int(np.ceil(OVERLAP * 512))
        assert np.abs(beats[:ends]).max() < 1e-9 * np.abs(beats[ends:]).min()


def test_an_echo_later_than_a_chirp_is_refused() -> None:
    with pytest.raises(ValueError, match="length_m must be under one chirp"):
        beam_beats(SMALL, one_path(chirp_span_m(SMALL, 1.01)), STATIC)


def test_an_unknown_precision_is_refused() -> None:
    with pytest.raises(ValueError, match=r"precision must be one of .*, got 'float16'"):
        kernel_profiles(SMALL, one_path(3.0), precision="float16")


# --- motion


@pytest.mark.parametrize("effects", [PLAIN, SignalEffects(range_migration=True)], ids=["doppler", "migration"])
def test_moving_echoes_over_a_beam(effects: SignalEffects) -> None:
    """Full chirp, 4 echoes up to 30 m/s, first, middle and last of 128 chirps. Reference: exact delays per sample.

    Slow-time terms hold 1e-5 rms of each path; S nu^2 t^2 / 2 left out is 1e-6. Tolerance 2e-5.
    """
    setup = RadarSetup(beams=BeamGrid(azimuth_deg=(5.0,)))
    paths = some_paths(4, 200.0, seed=6, speed_mps=30.0)
    chirps = [0, 64, 127]
    literal = literal_echoes(setup, paths, effects, chirps=chirps)
    beats, carrier, basis = beat_terms(setup, paths, effects)
    assert apart((carrier[:, None] * (basis.T @ beats))[chirps], literal) < 2e-5


def test_motion_with_everything_on() -> None:
    """Short chirps, 16 a beam, 20 echoes up to 15 m/s with squint, overlap, coupling, migration; 1e-5 of literal."""
    setup = RadarSetup(radar=RadarParams(samples_per_chirp=512, chirps_per_beam=16))
    paths = some_paths(20, chirp_span_m(setup, OVERLAP), two_ways=True, speed_mps=15.0)
    beats, carrier, basis = beat_terms(setup, paths, ALL, FAULTS, 2)
    literal = literal_echoes(setup, paths, ALL, FAULTS, 2, range(16))
    assert apart(carrier[:, None] * (basis.T @ beats), literal) < 1e-5


def test_migration_matters_at_road_speed() -> None:
    """30 m/s: 2.1 cm in a beam, a tenth of a bin: up to 0.15 rad at the ends of beam and sweep; some 5-10 % rms."""
    setup = RadarSetup(beams=BeamGrid(azimuth_deg=(0.0,)))
    path = one_path(60.0, speed_mps=30.0)
    exact = literal_echoes(setup, path, SignalEffects(range_migration=True), chirps=[0, 127])
    phase = literal_echoes(setup, path, SignalEffects(), chirps=[0, 127])
    assert 0.03 < apart(phase, exact) < 0.3


def test_one_profile_a_beam_refuses_motion() -> None:
    path = one_path(3.0, speed_mps=2.0)
    with pytest.raises(ValueError, match=r"at rest for one profile a beam, got 2\.00 m/s"):
        kernel_profiles(SMALL, path)
    frozen = kernel_profiles(SMALL, path, SignalEffects(motion=False), range_bins=40)
    np.testing.assert_array_equal(frozen, kernel_profiles(SMALL, one_path(3.0), range_bins=40))


# --- receiver, at both levels


@pytest.mark.parametrize("imbalance", [False, True])
@pytest.mark.parametrize("beat_sign", [1, -1])
def test_leakage_spurs_and_imbalance_at_both_levels(beat_sign: int, imbalance: bool) -> None:
    """Kernel against the mean over chirps of received samples without noise; float32 samples: 1e-6."""
    setup = msgspec.structs.replace(SMALL, beat_sign=beat_sign, beams=BeamGrid(azimuth_deg=(0.0, 20.0)))
    faults = FrontEnd(
        leakage_dbm=-60.0,
        iq_gain_db=0.5,
        iq_phase_deg=3.0,
        spurs=(Spur(frequency_hz=60.1e6, power_dbm=-70.0), Spur(frequency_hz=-31.7e6, power_dbm=-72.0)),
    )
    effects = SignalEffects(leakage=True, spurs=True, iq_imbalance=imbalance, chirp_overlap=True, thermal_noise=False)
    paths = louder(some_paths(30, 6.0, seed=9), 30.0)
    kernel = kernel_profiles(setup, paths, effects, faults, 80, seed=4)
    bank = noise_bank(setup.radar, 1)
    for beam in range(2):
        terms = beat_terms(setup, paths, effects, faults, beam, [4, 0, beam])
        samples = received_samples(setup, terms, bank, [0], effects, faults)
        recorded = samples if beat_sign > 0 else np.conj(samples)
        assert apart(kernel[beam], hann_profiles(recorded.mean(axis=0), 80)) < 2e-6


def test_image_stands_at_the_negative_frequency() -> None:
    """A spur at bin -40 with 0.5 dB and 3 deg: image at +40, |nu / mu|^2 = -28.2 dB below the tone's own power."""
    gain = 10.0 ** (0.5 / 20.0) * np.exp(1j * np.radians(3.0))
    rejection_db = 20.0 * np.log10(np.abs((1.0 - np.conj(gain)) / (1.0 + gain)))
    assert rejection_db == pytest.approx(-28.2, abs=0.1)
    spur = Spur(frequency_hz=-40.0 / SMALL.radar.chirp_period_s, power_dbm=-50.0)
    effects = SignalEffects(spurs=True, iq_imbalance=True)
    faults = msgspec.structs.replace(FAULTS, spurs=(spur,))
    profile = kernel_profiles(SMALL, some_paths(0, 1.0), effects, faults, 60)
    image_db = 20.0 * np.log10(np.abs(profile[3, 40]))
    assert image_db == pytest.approx(-50.0 + rejection_db + 20.0 * np.log10(np.abs(0.5 + 0.5 * gain)), abs=1e-6)


def test_objections_name_their_reason() -> None:
    """Fine; clipped by leakage (+10 dBm against -20 dBm full scale); 8 bits (256 codes a step, noise of 45)."""
    paths = some_paths(30, 6.0)
    assert kernel_objections(SMALL, paths) == []
    loud = kernel_objections(SMALL, paths, SignalEffects(leakage=True), FrontEnd(leakage_dbm=10.0))
    assert len(loud) == 1
    assert "the converter clips" in loud[0]
    coarse = kernel_objections(SMALL, paths, PLAIN, FrontEnd(adc_bits=8))
    assert len(coarse) == 1
    assert "noise of 256 codes" in coarse[0]
    assert kernel_objections(SMALL, paths, SignalEffects(adc=False), FrontEnd(adc_bits=8)) == []
    # without noise nothing makes rounding one
    assert len(kernel_objections(SMALL, paths, SignalEffects(thermal_noise=False))) == 1


def test_objections_look_twice_before_they_say_clipped() -> None:
    """1,000 echoes whose amplitudes add up to twice full scale, but not in phase: nothing clips, no objection."""
    setup = RadarSetup(radar=SMALL.radar, beams=BeamGrid(azimuth_deg=(0.0,)))
    paths = some_paths(1000, 6.0, seed=2)
    total = np.abs(swept_echoes(setup, paths, PLAIN, FrontEnd()).weights).sum()
    paths = louder(paths, 2.0 * 0.1 / total)  # full scale: -20 dBm, 0.1 sqrt(mW)
    peak = np.abs(beam_beats(setup, paths)).max()
    assert peak < 0.09
    assert kernel_objections(setup, paths) == []
    assert kernel_objections(setup, louder(paths, 0.11 / peak)) != []


def test_echo_profiles_of_negative_bins() -> None:
    """The bins that images come from: those of the FFT."""
    paths = some_paths(20, 6.0)
    echoes = swept_echoes(SMALL, paths, STATIC, FAULTS)
    beats = beam_beats(SMALL, paths, STATIC, FAULTS)
    spectrum = hann_profiles(beats, 512)
    got = echo_profiles(echoes, range(-50, 50))
    assert apart(got, np.concatenate([spectrum[:, -50:], spectrum[:, :50]], axis=1)) < 1e-9


def test_own_weights_of_the_set_up_are_used() -> None:
    """Measured steering weights stand for themselves; the switch of exact phases does not undo them."""
    measured = setup_weights(SMALL).astype(np.complex64)
    setup = msgspec.structs.replace(SMALL, steering_weights=measured)
    paths = some_paths(5, 5.0)
    exact = beam_beats(setup, paths, SignalEffects(quantised_phases=False))
    np.testing.assert_array_equal(exact, beam_beats(setup, paths))


def test_beats_keep_the_recorded_convention() -> None:
    path = one_path(5.0)
    one = RadarSetup(radar=SMALL.radar, array=ArrayParams(columns=1, rows=1), beams=BeamGrid(azimuth_deg=(0.0,)))
    gain = 10.0 ** (2 * 4.1 / 20.0)
    assert apart(beam_beats(one, path)[0], gain * beat_samples(SMALL.radar, np.array([5.0]))[0]) < 1e-9


@pytest.mark.parametrize("corner_hz", [0.0, 1e5])
def test_noise_rms_is_that_of_its_draws(corner_hz: float) -> None:
    """40 seeds of 25 beams: 1,000 draws a bin, whose rms scatters by 1.6 %; 8 % in all of the first 20 bins.

    With 1/f noise the window lifts bin 1 by what it takes from bin 0: 2.9 times its own density's rms.
    """
    setup, front_end = RadarSetup(), FrontEnd(flicker_corner_hz=corner_hz)
    effects = SignalEffects(flicker=True)
    draws = np.concatenate([noise_profiles(setup, seed, effects, front_end, range_bins=20) for seed in range(40)])
    found = np.sqrt(np.mean(np.abs(draws) ** 2, axis=0))
    np.testing.assert_allclose(found, noise_rms(setup, effects, front_end)[:20], rtol=0.08)
