"""One signal at three levels with one answer: kernel (profiles), beat (samples, codes), literal (Eq. (6) in time).

Kernel: echoes on a grid of half range bins, convolved with the window's spectrum; scenes that move:
`sim_player.signal.slow_time_profiles`. Beat: sums of tones over the chirp, slow-time terms, faults of the receiver,
int16 codes. Literal (`lab.tradeoff.literal_signal`): the reference. `PLAIN` effects give `sim_player.signal.fmcw`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from functools import lru_cache

import msgspec
import numpy as np
from scipy import fft
from threadpoolctl import ThreadpoolController

from models.physics.waveform import WINDOW_TAPS, beat_frequency_hz, doppler_turn_rad
from msgs.values.radar import RadarParams, RadarSetup
from sim_player.scene.front_end import NO_FAULTS, FrontEnd
from sim_player.signal.compiled_beats import ToneSums
from sim_player.signal.compiled_starts import StartSums, instants_of
from sim_player.signal.compiled_weights import EchoWeights
from sim_player.signal.fmcw import (
    KERNEL_WIDTH,
    OVERSAMPLING,
    SlowTimeTable,
    beam_codes,
    grid_spread,
    kernel_transform,
    noise_reads,
    slow_time_table,
)
from sim_player.signal.receiver import (
    converter_step,
    dither_objection,
    flicker_ratio,
    iq_factors,
    iq_imbalance,
    iq_mixing,
    leakage_beat,
    leakage_profile,
    overload_objection,
    quantisation_power_mw,
    spur_beat,
    spur_profile,
    spur_turns,
    with_flicker,
)
from sim_player.signal.swept_echoes import (
    TOLERANCE,
    SweptEchoes,
    cardinal_functions,
    check_precision,
    overlap_correction,
    single_echoes,
    sweep,
    sweep_swing_rad,
    swept_echoes,
)
from sim_player.signal.switches import PLAIN, SignalEffects, overlap_samples
from sim_player.trace.path_table import Paths

RANGE_BINS = 512
#: One beam as sum_r carrier[c] basis[r, c] beats[r]: beats [terms, samples], carrier [chirps], basis [terms, chirps].
Terms = tuple[np.ndarray, np.ndarray, np.ndarray]
#: Paths that share the same effects.
Group = tuple[Paths, SignalEffects]
#: Grid of the kernel level: whole blocks of range bins, so that scenes share their kernels; steps left free below 0.
BLOCK_BINS, MARGIN = 256, KERNEL_WIDTH // 2


# --- kernel level


def kernel_profiles(
    setup: RadarSetup,
    paths: Paths,
    effects: SignalEffects = PLAIN,
    front_end: FrontEnd = NO_FAULTS,
    range_bins: int = RANGE_BINS,
    precision: str = "float64",
    seed: int = 0,
) -> np.ndarray:
    """Return the Hann-windowed range profiles of all beams without noise, sqrt(mW); complex [beams, bins].

    Echoes, leakage and spurs (`seed`: phases), with I/Q imbalance; the beat level's to 1e-9 in float64, 1e-5 in
    float32. ValueError where this level cannot hold the signal (`kernel_objections`).
    """
    _refuse(motion_objection(paths, effects))
    echoes = swept_echoes(setup, paths, effects, front_end, precision=precision)
    images = effects.iq_imbalance and iq_factors(front_end)[1] != 0.0
    bins = range(1 - range_bins if images else 0, range_bins)
    profiles = echo_profiles(echoes, bins)
    for beam in range(len(profiles)):
        for tone in _fixed_profiles(setup, effects, front_end, bins, [seed, 0, beam]):
            profiles[beam] += tone
    if images:
        profiles = iq_imbalance(profiles, profiles[:, ::-1], front_end, setup.beat_sign)[:, range_bins - 1 :]
    return profiles


def kernel_objections(
    setup: RadarSetup, paths: Paths, effects: SignalEffects = PLAIN, front_end: FrontEnd = NO_FAULTS
) -> list[str]:
    """Return why the kernel level cannot hold a signal, if so: motion, little dither, a clipping converter."""
    objections = [motion_objection(paths, effects)]
    if effects.adc:
        objections.append(dither_objection(setup, front_end, effects.thermal_noise))
        objections.append(overload_objection(setup, _peak(setup, paths, effects, front_end)))
    return [reason for reason in objections if reason is not None]


def motion_objection(paths: Paths, effects: SignalEffects) -> str | None:
    """Return the reason why one profile a beam cannot hold Doppler, or None."""
    if not effects.motion or not np.any(paths.radial_speed_mps):
        return None
    fastest = float(np.abs(paths.radial_speed_mps).max())
    return f"paths must be at rest for one profile a beam, got {fastest:.2f} m/s: use the beat level or slow-time sums"


def _refuse(reason: str | None) -> None:
    if reason is not None:
        raise ValueError(reason)


def echo_profiles(echoes: SweptEchoes, bins: range) -> np.ndarray:
    """Return the Hann-windowed profiles of swept echoes in their precision, complex [rows, bins].

    On the `KERNEL_WIDTH` nearest half bins, convolved with window x cardinal function; the start in time.
    """
    # imported here: basic effects have no sweep
    from scipy.sparse import csr_array

    radar, (instants, rows) = echoes.radar, echoes.weights.shape[:2]
    kind, real = echoes.weights.dtype, echoes.weights.real.dtype
    count = radar.samples_per_chirp
    tone_bin = beat_frequency_hz(radar, echoes.length_m) * radar.chirp_period_s
    blocks = int(tone_bin.max(initial=0.0)) // BLOCK_BINS + 1
    steps, kernel = grid_spread(OVERSAMPLING * tone_bin)
    path = np.arange(len(tone_bin) + 1) * KERNEL_WIDTH
    size = OVERSAMPLING * BLOCK_BINS * blocks + 2 * MARGIN
    spreading = csr_array((kernel.astype(real).ravel(), (steps + MARGIN).ravel(), path), (len(tone_bin), size))
    centre = np.exp(2j * np.pi * ((tone_bin * ((count // 2) / count)) % 1.0)).astype(kind)
    flat = np.multiply(echoes.weights.reshape(instants * rows, -1).T, centre[:, None], order="C")
    grid = (spreading.T.tocsr() @ flat.view(real)).view(kind).reshape(size, instants, rows)
    kernels = _range_kernels(count, instants, bins, blocks, echoes.precision)
    spectrum = np.einsum("fkr,fk->fr", fft.fft(grid, len(kernels), axis=0), kernels)
    turns = np.exp(-2j * np.pi * (np.arange(bins.start, bins.stop) * (count // 2) % count) / count)
    profiles = fft.ifft(spectrum, axis=0)[: OVERSAMPLING * len(bins) : OVERSAMPLING].T * turns.astype(kind)
    if echoes.head_samples:
        profiles += hann_profiles(overlap_correction(echoes), count, bins)
    return profiles


@lru_cache(maxsize=16)
def _range_kernels(count: int, instants: int, bins: range, blocks: int, precision: str) -> np.ndarray:
    """Return the transforms of the kernels that carry the half-bin grid to the bins, complex [frequencies, instants].

    H_l = sum_n w(n) l_k(n) / K(n) exp(2 pi j l (n - N/2) / 2N) / N for a grid step l half bins over the bin, K the
    transform of the spreading kernel. Laid out so that out[2 a] of a circular convolution is bin `bins[a]`.
    """
    size = OVERSAMPLING * BLOCK_BINS * blocks + 2 * MARGIN
    length = fft.next_fast_len(size + OVERSAMPLING * len(bins))
    sample = np.arange(count) / count
    nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(instants) + 0.5) / instants)
    slow = cardinal_functions(nodes, sample) * (1.0 - np.cos(2.0 * np.pi * sample)) / (kernel_transform(count) * count)
    table = fft.ifft(slow, OVERSAMPLING * count, axis=1, norm="forward")
    # u = 2 a - j over all grid steps j and bins a
    lag = np.arange(-(size - 1), OVERSAMPLING * (len(bins) - 1) + 1)
    step = -lag - MARGIN - OVERSAMPLING * bins.start
    half = (step * (count // 2)) % (OVERSAMPLING * count) / (OVERSAMPLING * count)
    laid = np.zeros((length, instants), np.complex128)
    laid[lag % length] = (table[:, step % (OVERSAMPLING * count)] * np.exp(-2j * np.pi * half)).T
    return fft.fft(laid, axis=0).astype(np.complex64 if precision == "float32" else np.complex128)


def hann_profiles(samples: np.ndarray, count: int, bins: range = range(RANGE_BINS)) -> np.ndarray:
    """Return the Hann-windowed profiles [rows, bins] of chirps of `count` samples; missing ones are zero."""
    window = (1.0 - np.cos(2.0 * np.pi * np.arange(samples.shape[1]) / count)).astype(samples.real.dtype) / count
    return fft.fft(samples * window, count, axis=1)[:, np.arange(bins.start, bins.stop) % count]


def _fixed_profiles(
    setup: RadarSetup, effects: SignalEffects, front_end: FrontEnd, bins: range, seed: Sequence[int]
) -> Iterator[np.ndarray]:
    """Yield the profiles of leakage and spurs of one beam."""
    if effects.leakage and front_end.leakage_dbm is not None:
        yield leakage_profile(setup.radar, front_end.leakage_dbm, front_end.leakage_range_m, bins)
    if not effects.spurs or not front_end.spurs:
        return
    for spur, turns in zip(front_end.spurs, spur_turns(front_end.spurs, seed), strict=True):
        if setup.beat_sign > 0:
            yield spur_profile(setup.radar, spur, turns, bins)
        else:
            # the receiver conjugates its input: the tone lies at -f
            mirrored = range(1 - bins.stop, 1 - bins.start)
            yield np.conj(spur_profile(setup.radar, spur, turns, mirrored)[::-1])


def noise_profiles(
    setup: RadarSetup,
    seed: int,
    effects: SignalEffects = PLAIN,
    front_end: FrontEnd = NO_FAULTS,
    range_bins: int = RANGE_BINS,
) -> np.ndarray:
    """Return the noise of all beams as windowed profiles: thermal, flicker, rounding; complex128 [beams, bins]."""
    power_mw = noise_density_mw(setup, np.arange(-1, range_bins + 1), effects, front_end)
    rng = np.random.default_rng([seed, 6])
    return windowed_noise(rng, np.broadcast_to(power_mw, (len(setup.beams), len(power_mw))))


def windowed_noise(rng: np.random.Generator, power_mw: np.ndarray) -> np.ndarray:
    """Return draws of noise with a power per bin [rows, bins + 2] after the Hann window; complex128 [rows, bins]."""
    taps = WINDOW_TAPS["hann"]
    draws = rng.standard_normal((2, *power_mw.shape)) * np.sqrt(0.5 * power_mw)
    white = draws[0] + 1j * draws[1]
    bins = power_mw.shape[1] - len(taps) + 1
    return sum(tap * white[:, i : i + bins] for i, tap in enumerate(taps))


def noise_density_mw(
    setup: RadarSetup, bins: np.ndarray, effects: SignalEffects = PLAIN, front_end: FrontEnd = NO_FAULTS
) -> np.ndarray:
    """Return the noise power per bin before the window, after the mean over chirps; mW, float64 [bins].

    (thermal + flicker) (|mu|^2 + |nu|^2) + rounding, over N N_c. ValueError where rounding is no white noise.
    """
    radar = setup.radar
    per_sample = np.full(len(bins), radar.noise_power_mw if effects.thermal_noise else 0.0)
    if effects.flicker:
        frequency_hz = np.asarray(bins) / radar.chirp_period_s
        per_sample += radar.noise_power_mw * flicker_ratio(radar, frequency_hz, front_end.flicker_corner_hz)
    if effects.iq_imbalance:
        per_sample *= sum(abs(factor) ** 2 for factor in iq_factors(front_end))
    if effects.adc:
        _refuse(dither_objection(setup, front_end, effects.thermal_noise))
        per_sample += quantisation_power_mw(setup, converter_step(front_end))
    return per_sample / (radar.samples_per_chirp * radar.chirps_per_beam)


def noise_rms(setup: RadarSetup, effects: SignalEffects = PLAIN, front_end: FrontEnd = NO_FAULTS) -> np.ndarray:
    """Return the rms of the noise in a Hann-windowed profile, sqrt(mW); float64 [512]."""
    density = noise_density_mw(setup, np.arange(-1, RANGE_BINS + 1), effects, front_end)
    # the window brings in the neighbours: 1/f noise is far stronger in the first bin than beside it
    return np.sqrt(np.convolve(density, np.square(WINDOW_TAPS["hann"]), "valid"))


def _peak(setup: RadarSetup, paths: Paths, effects: SignalEffects, front_end: FrontEnd) -> float:
    """Return the largest magnitude at the converter in any beam, noise at five sigma; a bound where harmless."""
    # the overlap exchanges echoes for similar ones
    lone = msgspec.structs.replace(effects, chirp_overlap=False)
    echoes = swept_echoes(setup, paths, lone, front_end, precision="float32")
    fixed = sum(np.abs(tone).max() for tone, _ in _fixed_beats(setup, effects, front_end, [0]))
    if effects.thermal_noise:
        fixed += 5.0 * np.sqrt(0.5 * setup.radar.noise_power_mw)
    gain = sum(map(abs, iq_factors(front_end))) if effects.iq_imbalance else 1.0
    amplitude = np.abs(echoes.weights).sum(axis=2).max(axis=0)
    for beam, bound in enumerate(amplitude):
        if overload_objection(setup, gain * (bound + fixed)) is not None:
            beats = beam_beats(setup, paths, effects, front_end, slice(beam, beam + 1))
            amplitude[beam] = np.abs(beats).max()
    return float(gain * (amplitude.max() + fixed))


# --- beat level


def beam_beats(
    setup: RadarSetup,
    paths: Paths,
    effects: SignalEffects = PLAIN,
    front_end: FrontEnd = NO_FAULTS,
    beams: slice = slice(None),
) -> np.ndarray:
    """Return the echoes of one chirp of each beam of a scene at rest, in sqrt(mW); complex128 [beams, samples]."""
    return group_beats(setup, [(paths, effects)], front_end, beams)


def group_beats(
    setup: RadarSetup,
    groups: Sequence[Group],
    front_end: FrontEnd = NO_FAULTS,
    beams: slice = slice(None),
    precision: str = "float64",
) -> np.ndarray:
    """Return the same of groups of paths with effects of their own, at one price; in float32 to 3e-6 of all."""
    rows = len(range(len(setup.beams))[beams])
    with _one_thread():
        make = single_echoes if precision == "float32" else swept_echoes
        echoes = [make(setup, paths, effects, front_end, beams) for paths, effects in groups]
        return _summed(setup.radar, echoes, rows, precision)


def echo_terms(
    setup: RadarSetup,
    paths: Paths,
    effects: SignalEffects = PLAIN,
    front_end: FrontEnd = NO_FAULTS,
    beam: int = 0,
    precision: str = "float64",
    overlaps: np.ndarray | None = None,
) -> Terms:
    """Return the echoes of one beam alone, the same from scan to scan at rest; in float32 to 1e-4 of the strongest.

    `overlaps` bool [P]: paths with the last chirp's echoes; None: all. ValueError for an unknown precision.
    """
    check_precision(precision)
    radar = setup.radar
    overlaps = np.full(len(paths), effects.chirp_overlap) if overlaps is None else overlaps & effects.chirp_overlap
    # along the sweep a migrating path's Doppler follows the frequency
    margin = 1.0 + radar.bandwidth_hz / radar.carrier_hz * effects.range_migration
    slow = slow_time_table(radar, doppler_turn_rad(radar, paths.radial_speed_mps * effects.motion), margin)
    if precision == "float64":
        steady = msgspec.structs.replace(effects, chirp_overlap=False)
        parts = ((overlaps, effects), (~overlaps, steady))
        groups = [(paths.take(mask), flags) for mask, flags in parts if mask.any()] or [(paths, steady)]
        with _one_thread():
            moving = [_moving_echoes(setup, group, front_end, beam, slow) for group in groups]
            return _summed(radar, moving, len(slow.basis)), slow.carrier, slow.basis
    sums = ToneSums(radar, float(paths.length_m.max(initial=0.0)), len(slow.basis), precision)
    swing_rad = sweep_swing_rad(setup, paths, effects)
    last = int(overlap_samples(radar, paths.length_m[overlaps]).max(initial=0))
    starts = StartSums(radar, last, swing_rad) if last else None
    span = starts.span if starts else 1.0
    instants = instants_of(swing_rad, span)
    weigh = EchoWeights(setup, (paths, effects), front_end, beam, slow, instants, TOLERANCE[precision], np.float32)
    cycles = beat_frequency_hz(radar, weigh.length_m) / radar.sample_rate_hz
    sums.add(cycles, weigh.weights, span)
    beats = sums.beats()
    if starts:
        rows = slice(None) if overlaps.all() else np.flatnonzero(overlaps[weigh.rows])
        previous, ends = weigh.previous_chirp(), overlap_samples(radar, weigh.length_m[rows])
        start = (previous[0][rows], previous[1][rows])
        correction = starts.correction(np.ascontiguousarray(weigh.weights[..., rows]), start, cycles[rows], ends)
        beats[:, : correction.shape[1]] += correction
    return beats, slow.carrier, slow.basis


def _one_thread() -> AbstractContextManager[None]:
    """Keep matrix products to one thread: several are slower for these, and their last bits follow their number."""
    return _blas().limit(limits=1, user_api="blas")


@lru_cache(maxsize=1)
def _blas() -> ThreadpoolController:
    return ThreadpoolController()


def _moving_echoes(setup: RadarSetup, group: Group, front_end: FrontEnd, beam: int, slow: SlowTimeTable) -> SweptEchoes:
    """Return the echoes of one beam, one row per slow-time term, in float64."""
    paths, effects = group
    weigh = EchoWeights(setup, group, front_end, beam, slow, np.array([0.5]), 0.0, np.float64)

    def values(instants: list[tuple[float, bool]]) -> np.ndarray:
        share, previous = np.array([share for share, _ in instants]), np.array([late for _, late in instants])
        real, imaginary = weigh.at(share + previous)
        weights = real + 1j * imaginary
        start, slope = weigh.previous_chirp()
        weights[previous] *= (start * (1.0 + np.multiply.outer(share[previous], slope)))[:, None]
        return np.asarray(weights)

    swing_rad = sweep_swing_rad(setup, paths, effects)
    return sweep(setup.radar, weigh.length_m, swing_rad, effects.chirp_overlap, values, "float64")


def with_electronics(
    setup: RadarSetup, terms: Terms, effects: SignalEffects, front_end: FrontEnd, seed: Sequence[int] = (0,)
) -> Terms:
    """Return the terms with those of leakage and spurs added; `seed` names the beam."""
    carrier = terms[1]
    beats, rows = [terms[0]], [terms[2]]
    for tone, phasor in _fixed_beats(setup, effects, front_end, seed):
        relative = phasor * np.conj(carrier)
        beats.append(np.stack([tone, 1j * tone]))
        rows.append(np.stack([relative.real, relative.imag]))
    return np.concatenate(beats), carrier, np.concatenate(rows)


def record_beam(
    setup: RadarSetup,
    terms: Terms,
    bank: np.ndarray,
    seed: list[int],
    effects: SignalEffects = PLAIN,
    front_end: FrontEnd = NO_FAULTS,
) -> np.ndarray:
    """Return int16 I/Q codes of one beam, [chirps, samples, 2], of `echo_terms` with `with_electronics`."""
    radar = setup.radar
    noise = noise_reads(radar, bank if effects.thermal_noise else np.zeros_like(bank), seed)
    if effects.flicker and front_end.flicker_corner_hz > 0.0:
        noise = with_flicker(radar, noise, front_end.flicker_corner_hz, seed)
    mixing = iq_mixing(front_end) if effects.iq_imbalance else None
    return beam_codes(setup, *terms, noise, mixing, converter_step(front_end) if effects.adc else 1)


def _summed(radar: RadarParams, groups: Sequence[SweptEchoes], rows: int, precision: str = "float64") -> np.ndarray:
    """Return the samples of swept echoes over one chirp, complex [rows, samples] of the precision."""
    longest_m = max(float(echoes.length_m.max(initial=0.0)) for echoes in groups)
    sums = ToneSums(radar, longest_m, rows, precision)
    for echoes in groups:
        cycles = beat_frequency_hz(radar, echoes.length_m) / radar.sample_rate_hz
        sums.add(cycles, np.stack([echoes.weights.real, echoes.weights.imag]))
    beats = sums.beats()
    for echoes in groups:
        beats[:, : echoes.head_samples] += overlap_correction(echoes)
    return beats


def _fixed_beats(
    setup: RadarSetup, effects: SignalEffects, front_end: FrontEnd, seed: Sequence[int]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield leakage and spurs of one beam: one chirp of each and its phasor per chirp."""
    radar = setup.radar
    if effects.leakage and front_end.leakage_dbm is not None:
        yield leakage_beat(radar, front_end.leakage_dbm, front_end.leakage_range_m), np.ones(radar.chirps_per_beam)
    if not effects.spurs or not front_end.spurs:
        return
    for spur, turns in zip(front_end.spurs, spur_turns(front_end.spurs, seed), strict=True):
        tone, phasor = spur_beat(radar, spur, turns)
        # spurs do not pass the mixer: undo the hardware's sign, which is applied to all terms later
        yield (tone, phasor) if setup.beat_sign > 0 else (np.conj(tone), np.conj(phasor))
