"""Hard cases of phase: thousands of turns at 10 and 77 GHz, whole frames and scans, spectra on bins and beside."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from mpmath import mp, mpf

from lab.tradeoff.literal_signal import literal_echoes
from models.perception.form.ra_forming import BeamFolder, FormingParams, ego_correction
from models.physics.waveform import beat_phase_rad, beat_samples, tone_profile
from msgs.values.radar import BeamGrid, RadarParams, RadarSetup, RangeAzimuthGrid
from msgs.values.units import SPEED_OF_LIGHT_MPS
from msgs.values.vehicle import VehicleState
from sim_player.signal.compiled_beats import ToneSums
from sim_player.signal.fmcw import slow_time_table
from sim_player.signal.switches import PLAIN
from tests.sim_player.signal.references import literal_beats
from tests.sim_player.signal.test_levels import one_path
from tests.stability.catalogue import Errors

TURN_RAD = 2.0 * np.pi
EPS = 2.0**-52
#: Round trips of 0.1..110 m of range, exact in float32: what is lost is lost by the arithmetic.
LENGTH_M = np.linspace(0.2, 220.0, 500).astype(np.float32).astype(np.float64)


def radar_at(carrier_hz: float, samples: int = 8192) -> RadarParams:
    """The radar at a carrier, its chirp as long as ever, sampled as often as asked."""
    return RadarParams(carrier_hz=carrier_hz, samples_per_chirp=samples, sample_rate_hz=1.5e9 * samples / 8192)


def slope(radar: RadarParams) -> Fraction:
    """S without rounding."""
    return Fraction(radar.bandwidth_hz) * Fraction(radar.sample_rate_hz) / radar.samples_per_chirp


def exact_rad(radar: RadarParams, length_m: float, sample: int = 0, moved_m: Fraction | int = 0) -> float:
    """Phase of the recorded beat by exact mixing of Eq. (6) with its echo, in [0, 2 pi).

    f_c t + S t^2 / 2 minus the same at t - tau, in rational numbers; `moved_m` turns the carrier alone.
    """
    carrier, light = Fraction(radar.carrier_hz), Fraction(SPEED_OF_LIGHT_MPS)
    time_s = sample / Fraction(radar.sample_rate_hz)
    delay_s = Fraction(length_m) / light
    sent, came = (carrier * t + slope(radar) * t * t / 2 for t in (time_s, time_s - delay_s))
    return TURN_RAD * float((sent - came + carrier * moved_m / light) % 1)


def off_rad(phase_rad: np.ndarray, exact: np.ndarray | list[float]) -> float:
    """Largest difference of angles, the short way round."""
    turns = (np.asarray(phase_rad, np.float64) - np.asarray(exact)) / TURN_RAD
    return float(TURN_RAD * np.abs(turns - np.round(turns)).max())


def both_bands(where: str, naive: str, bounds: tuple[float, float], source: str) -> pytest.MarkDecorator:
    """The case at 10 and at 77 GHz, each with its bound in rad."""
    return pytest.mark.parametrize(
        "carrier_hz",
        [
            pytest.param(
                carrier_hz,
                id=f"{carrier_hz / 1e9:.0f} GHz",
                marks=pytest.mark.hard(where, naive, bound, "rad", source),
            )
            for carrier_hz, bound in zip((10e9, 77e9), bounds, strict=True)
        ],
    )


@both_bands(
    where="models.physics.waveform",
    naive="2 pi f_c tau - pi S tau^2 in float32",
    bounds=(2.1e-11, 1.6e-10),
    source="four roundings of 7,300 (56,500) turns in float64",
)
def test_phase_of_a_beat_to_110_m(errors: Errors, carrier_hz: float) -> None:
    """220 m are thousands of turns: float32 keeps three or four digits of the last one."""
    radar = radar_at(carrier_hz)
    tau = (LENGTH_M.astype(np.float32) / np.float32(SPEED_OF_LIGHT_MPS)).astype(np.float32)
    naive = np.float32(TURN_RAD * carrier_hz) * tau - np.float32(np.pi * radar.chirp_slope_hz_per_s) * tau * tau
    assert naive.dtype == np.float32
    exact = [exact_rad(radar, length) for length in LENGTH_M]
    errors(naive=off_rad(naive, exact), ours=off_rad(beat_phase_rad(radar, LENGTH_M), exact))


@pytest.mark.hard("models.physics.waveform", "cast to float32 before the turns are taken out", 2.4e-7, "rad",
                  "half a step of float32 below 2 pi")  # fmt: skip
def test_phase_is_wrapped_before_it_is_cast(errors: Errors) -> None:
    """77 GHz at 110 m is 3.6e5 rad, and steps of float32 there are 1/32 rad, however exact the phase was."""
    radar = radar_at(77e9)
    delay_s = LENGTH_M / SPEED_OF_LIGHT_MPS
    whole = TURN_RAD * (LENGTH_M / radar.wavelength_m - 0.5 * radar.chirp_slope_hz_per_s * delay_s**2)
    exact = [exact_rad(radar, length) for length in LENGTH_M]
    ours = beat_phase_rad(radar, LENGTH_M).astype(np.float32)
    errors(naive=off_rad(whole.astype(np.float32), exact), ours=off_rad(ours, exact))


@pytest.mark.hard("models.physics.waveform", "residual video phase left out", 3e-11, "rad",
                  "rounding of 7,900 turns in float64")  # fmt: skip
def test_residual_video_phase_is_kept(errors: Errors) -> None:
    """pi S tau^2 is 34.5 turns at 110 m: no phase is right without it, at any sample."""
    radar = radar_at(10e9)
    samples, length = (0, 1, 4096, 8191), LENGTH_M[::25]
    beats = beat_samples(radar, length)[:, samples]
    tone = np.multiply.outer(length * radar.chirp_slope_hz_per_s / SPEED_OF_LIGHT_MPS / radar.sample_rate_hz, samples)
    naive = TURN_RAD * ((tone + (length / radar.wavelength_m)[:, None]) % 1.0)
    exact = [[exact_rad(radar, one, sample) for sample in samples] for one in length]
    errors(naive=off_rad(naive, exact), ours=off_rad(np.angle(beats), exact))


@pytest.mark.hard("models.physics.waveform", "phasor turned on from sample to sample in complex64", 3e-12, "rad",
                  "eight roundings of 514 turns in float64")  # fmt: skip
def test_a_beat_over_its_chirp(errors: Errors) -> None:
    """8,192 samples and 514 turns on: every rounding of a recurrence stays in it."""
    radar = radar_at(10e9)
    length, samples = LENGTH_M[::100], np.arange(0, 8192, 455)
    step = np.exp(1j * TURN_RAD * radar.chirp_slope_hz_per_s * length / SPEED_OF_LIGHT_MPS / radar.sample_rate_hz)
    steps = np.repeat(step[:, None].astype(np.complex64), 8191, axis=1)
    naive = np.concatenate([np.ones((len(length), 1), np.complex64), np.cumprod(steps, axis=1)], axis=1)
    ours = beat_samples(radar, length)
    per_sample = [slope(radar) * Fraction(one) / Fraction(SPEED_OF_LIGHT_MPS) for one in length]
    rate = Fraction(radar.sample_rate_hz)
    exact = [[TURN_RAD * float((hz * int(n) / rate) % 1) for n in samples] for hz in per_sample]
    turned = ours[:, samples] * np.conj(ours[:, :1])
    errors(naive=off_rad(np.angle(naive[:, samples]), exact), ours=off_rad(np.angle(turned), exact))


@both_bands(
    where="sim_player.signal.fmcw",
    naive="f_c t with t over the frame, in float32",
    bounds=(3.2e-10, 2.4e-9),
    source="four roundings of f_c T_c + S T_c^2 / 2, 56,500 (422,000) turns, in float64",
)
def test_last_chirp_of_a_frame(errors: Errors, carrier_hz: float) -> None:
    """0.7 ms are 7e6 (5e7) turns of the carrier: in float32 the phase is gone. Time runs from each chirp's start."""
    radar = radar_at(carrier_hz, 512)
    samples, light = np.arange(0, 512, 73), np.float32(SPEED_OF_LIGHT_MPS)
    time_s = np.float32(127 * radar.chirp_period_s) + (samples / radar.sample_rate_hz).astype(np.float32)
    since_s = (samples / radar.sample_rate_hz).astype(np.float32)
    carrier, half = np.float32(carrier_hz), np.float32(0.5 * radar.chirp_slope_hz_per_s)
    naive, ours, exact = [], [], []
    for length in LENGTH_M[::50]:
        tau = np.float32(length) / light
        turns = carrier * time_s - carrier * (time_s - tau) + half * since_s**2 - half * (since_s - tau) ** 2
        naive.append(np.float32(TURN_RAD) * turns)
        ours.append(np.angle(literal_beats(radar, np.array([length]), np.ones(1), 128)[127, samples]))
        exact.append([exact_rad(radar, length, int(n)) for n in samples])
    errors(naive=off_rad(np.array(naive), exact), ours=off_rad(np.array(ours), exact))


@pytest.mark.hard("lab.tradeoff.literal_signal", "f_c (t - tau(t)) with absolute time in float32", 2.4e-9, "rad",
                  "four roundings of 422,000 turns in float64")  # fmt: skip
def test_last_chirp_of_a_frame_of_a_moving_path(errors: Errors) -> None:
    """A car at 30 m/s at 77 GHz, last of 128 chirps: 5.4 turns of motion stand beside 5e7 of the carrier."""
    radar, length, speed = radar_at(77e9, 512), LENGTH_M[400], 30.0
    setup = RadarSetup(radar=radar, beams=BeamGrid(azimuth_deg=(0.0,)))
    ours = np.angle(literal_echoes(setup, one_path(length, speed_mps=speed), PLAIN, chirps=(127,))[0])
    since_middle_s = (127 - Fraction(127, 2)) * 512 / Fraction(radar.sample_rate_hz)
    moved_m = 2 * Fraction(speed) * since_middle_s
    exact = [exact_rad(radar, length, n, moved_m) for n in range(512)]
    since_s = (np.arange(512) / radar.sample_rate_hz).astype(np.float32)
    time_s = np.float32(127 * radar.chirp_period_s) + since_s
    tau = np.float32(length + float(moved_m)) / np.float32(SPEED_OF_LIGHT_MPS)
    half, carrier = np.float32(0.5 * radar.chirp_slope_hz_per_s), np.float32(radar.carrier_hz)
    turns = carrier * time_s - carrier * (time_s - tau) + half * since_s**2 - half * (since_s - tau) ** 2
    errors(naive=off_rad(np.float32(TURN_RAD) * turns, exact), ours=off_rad(ours, exact))


@pytest.mark.hard("sim_player.signal.fmcw", "f_c (L + 2 v t) / c of every chirp in float32", 2e-5, "rad rms",
                  "the tolerance of the slow-time basis, 1e-5 of a path, twice")  # fmt: skip
def test_slow_time_of_a_frame(errors: Errors) -> None:
    """-15 to 40 m/s at 77 GHz from 220 m: 10 turns in a frame, read off 56,500."""
    radar, length = radar_at(77e9), 220.0
    speeds = np.linspace(-15.0, 40.0, 12)
    turns = 4.0 * np.pi * speeds * radar.chirp_period_s / radar.wavelength_m
    table = slow_time_table(radar, turns)
    got = table.carrier[:, None] * (table.basis.T @ table.shares(turns))
    chirps = [Fraction(2 * chirp - 127, 2) for chirp in range(128)]
    rate = 2 * Fraction(radar.carrier_hz) / Fraction(SPEED_OF_LIGHT_MPS) * 8192 / Fraction(radar.sample_rate_hz)
    exact = np.exp(1j * TURN_RAD * np.array([[float(rate * Fraction(v) * c % 1) for v in speeds] for c in chirps]))
    time_s = np.array([float(c) for c in chirps], np.float32)[:, None] * np.float32(radar.chirp_period_s)
    away_m = np.float32(length) + 2 * speeds.astype(np.float32) * time_s
    start = np.float32(TURN_RAD / radar.wavelength_m)
    naive = np.exp(1j * (start * away_m).astype(np.float64)) * np.exp(-1j * float(start * np.float32(length)))
    off = [np.sqrt(np.mean(np.abs(one - exact) ** 2, axis=0)).max() for one in (naive, got)]
    errors(naive=off[0], ours=off[1])


@both_bands(
    where="models.perception.form.ra_forming",
    naive="4 pi v t cos(azimuth) / lambda in float32",
    bounds=(4.3e-8, 4.3e-8),
    source="both parts rounded to complex64, half a step of 6e-8 each; the turns in float64 add 1e-11",
)
def test_own_motion_over_a_scan(errors: Errors, carrier_hz: float) -> None:
    """25 beams in 0.3 s at 30 m/s: 9 m, and 600 (4,600) turns from the first beam to the last."""
    setup = RadarSetup(radar=radar_at(carrier_hz))
    folder = BeamFolder(setup, FormingParams(), RangeAzimuthGrid())
    state = VehicleState(stamp_ns=0, speed_mps=30.0, yaw_rate_rps=0.0)
    naive, ours, exact = [], [], []
    for beam, azimuth_rad in enumerate(setup.beams.azimuth_rad):
        elapsed_s = 0.012 * beam
        ours.append(np.angle(ego_correction(folder, beam, elapsed_s, state).group_phase.astype(complex)))
        times_s = elapsed_s + folder.group_time_s
        with mp.workdps(40):
            per_s = 2 * mpf(30) * mp.cos(mpf(float(azimuth_rad))) * mpf(carrier_hz) / mpf(SPEED_OF_LIGHT_MPS)
            exact.append([TURN_RAD * float(per_s * mpf(float(t)) % 1) for t in times_s])
        shift_m = np.float32(30.0) * times_s.astype(np.float32) * np.cos(np.float32(azimuth_rad))
        naive.append(np.float32(2.0 * TURN_RAD / setup.radar.wavelength_m) * shift_m)
    errors(naive=off_rad(np.array(naive), exact), ours=off_rad(np.array(ours), exact))


def exact_profile(count: int, tone_bin: float, bins: range) -> np.ndarray:
    """The transform of a tone, divided by its length: the geometric series in 60 digits."""
    with mp.workdps(60):
        out = []
        for i in bins:
            x = mpf(tone_bin) - i
            bottom = count * mp.sin(mp.pi * x / count)
            ratio = mpf(1) if x == 0 else mp.sin(mp.pi * x) / bottom
            if x % count == 0:
                ratio = mpf(1) if ((count - 1) * (x / count)) % 2 == 0 else mpf(-1)
            out.append(complex(ratio * mp.expj(mp.pi * (count - 1) / count * x)))
    return np.array(out)


def naive_profile(count: int, tone_bin: float, bins: range) -> np.ndarray:
    """The geometric series as it stands in the textbook."""
    x = tone_bin - np.array(bins)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.sin(np.pi * x) / (count * np.sin(np.pi * x / count))
    return ratio * np.exp(1j * np.pi * (count - 1) / count * x)


def largest(errors_found: list[np.ndarray]) -> float:
    """The largest of all, NaN if there is one."""
    return float(np.max(np.abs(np.concatenate(errors_found))))


@pytest.mark.hard("models.physics.waveform", "sin(pi x) / (N sin(pi x / N))", 1e-14, "",
                  "the phase pi x (N - 1) / N, to x = 11, in two roundings")  # fmt: skip
def test_a_tone_on_its_bin(errors: Errors) -> None:
    """A target in the middle of a bin: 0 / 0. Beside it both sines vanish together."""
    bins, tones = range(90, 111), (100.0, 100.0 + 1e-13, 100.5, 101.0 - 2e-14)
    exact = [exact_profile(8192, tone, bins) for tone in tones]
    ours = [tone_profile(8192, np.array(tone), 21, "none", 90) for tone in tones]
    naive = [naive_profile(8192, tone, bins) for tone in tones]
    errors(
        naive=largest([one - right for one, right in zip(naive, exact, strict=True)]),
        ours=largest([one - right for one, right in zip(ours, exact, strict=True)]),
    )


@pytest.mark.hard("models.physics.waveform", "sin(pi x) / (N sin(pi x / N))", 6e-12, "",
                  "the phase pi x (N - 1) / N, to x = 6,000, in two roundings")  # fmt: skip
def test_a_tone_one_turn_a_sample_away(errors: Errors) -> None:
    """Bin 0 of a tone just below bin 6,000: x / N is nearly 1, and what is left of both sines is rounding.

    (For a count that is a power of two both roundings are the same and cancel.)
    """
    tones = 6000.0 - np.array([1e-3, 1e-6, 1e-9, 2e-12])
    exact = [exact_profile(6000, tone, range(2)) for tone in tones]
    ours = [tone_profile(6000, np.array(tone), 2, "none") for tone in tones]
    naive = [naive_profile(6000, tone, range(2)) for tone in tones]
    errors(
        naive=largest([one - right for one, right in zip(naive, exact, strict=True)]),
        ours=largest([one - right for one, right in zip(ours, exact, strict=True)]),
    )


@pytest.mark.hard("models.physics.waveform", "sinc(x) / (1 - x^2)", 1e-15, "", "rounding of sin(pi) and of three taps")
def test_hann_window_one_bin_off(errors: Errors) -> None:
    """The window's own closed form is 0 / 0 one bin beside the tone; the limit is -1/2 at unit coherent gain."""
    x = np.arange(-2.0, 3.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        naive = np.sinc(x) / (1.0 - x**2) * np.cos(np.pi * x)
    limit = np.array([0.0, -0.5, 1.0, -0.5, 0.0])
    ours = tone_profile(8192, np.array(100.0), 5, "hann", 98)
    errors(naive=np.abs(naive - limit).max(), ours=np.abs(ours - limit).max())


@pytest.mark.hard("sim_player.signal.compiled_beats", "grid step taken from the fraction of a turn", 1e-9,
                  "of the tone", "the gridding kernel, 1e-12 of the strongest tone, over 14 steps")  # fmt: skip
def test_a_tone_a_rounding_below_zero(errors: Errors) -> None:
    """-1e-18 turns a sample: its fraction of a turn rounds up to a whole one, a step beyond the grid's last."""
    cycles = np.array([-1e-18])
    naive = np.inf
    grid = np.zeros(2 * 512, np.complex128)
    try:
        grid[int((cycles[0] % 1.0) * 1024)] = 1.0
        naive = np.abs(np.fft.ifft(grid, norm="forward")[:512] - 1.0).max()
    except IndexError:
        pass
    # a band of all frequencies: summed at the full rate
    sums = ToneSums(RadarParams(samples_per_chirp=512), 2e3, 1, "float64")
    sums.add(cycles, np.array([1.0, 0.0]).reshape(2, 1, 1, 1))
    errors(naive=naive, ours=np.abs(sums.beats() - 1.0).max())
