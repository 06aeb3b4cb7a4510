"""Echoes whose weight changes slowly along the chirp: squint, range migration, and the previous chirp's tail.

The slow factor is taken at Chebyshev instants, beat(t) = sum_k l_k(t) a(t_k) tone(t); a phase that swings by +-alpha
needs them until the Bessel functions J_k(alpha) are gone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import jv

from models.compiled import compiled
from models.physics.antenna import element_field, two_way_pattern
from models.physics.waveform import beat_frequency_hz, beat_phase_rad
from msgs.values.radar import RadarParams, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.fmcw import departure
from sim_player.signal.switches import (
    SignalEffects,
    column_weights,
    isotropic,
    overlap_samples,
    previous_length_m,
    sampled,
    sweep_ratio,
)
from sim_player.trace.path_table import Paths

#: Largest error of the interpolation along the chirp, relative to the array's peak.
TOLERANCE = {"float64": 1e-11, "float32": 1e-5}
#: Samples of the overlapped start that are processed at a time.
CHUNK = 64


@dataclass(frozen=True)
class SweptEchoes:
    """P echoes in R rows (beams, or the slow-time terms of one)."""

    radar: RadarParams
    length_m: np.ndarray
    #: Instants as shares of the chirp [K], and recorded weights there, beat phase included: [K, R, P].
    instants: np.ndarray
    weights: np.ndarray
    #: The same over the overlapped start, `head_samples` long, instants over its whole chunks (share of the chirp):
    #: own chirp's echo to take off, last chirp's to put in.
    head_samples: int
    head_span: float
    head_instants: np.ndarray
    head_own: np.ndarray
    head_previous: np.ndarray
    #: Bound of half the phase sweep of the slow factor in a chirp; precision of the weights.
    swing_rad: float
    precision: str


def cardinal_functions(instants: np.ndarray, share: np.ndarray, span: float = 1.0) -> np.ndarray:
    """Return the polynomials that are 1 at one Chebyshev instant and 0 at the others; float64 [instants, shares].

    l_k(x) = (1 + 2 sum_m T_m(x_k) T_m(x)) / K on [0, span], without divisions.
    """
    count = len(instants)
    scale = np.full(count, 2.0 / count)
    scale[0] = 1.0 / count

    def table(at: np.ndarray) -> np.ndarray:
        return np.polynomial.chebyshev.chebvander(2.0 * at / span - 1.0, count - 1)

    return (table(instants) * scale) @ table(np.asarray(share, np.float64)).T


@lru_cache(maxsize=512)
def chebyshev_instants(swing_rad: float, tolerance: float, span: float = 1.0) -> np.ndarray:
    """Return the fewest Chebyshev points of [0, span] that interpolate exp(j swing x), |x| <= 1, to a tolerance."""
    orders = np.abs(jv(np.arange(int(2.0 * swing_rad) + 60), swing_rad))
    left = 4.0 * np.cumsum(orders[::-1])[::-1]
    return chebyshev_nodes(max(int(np.argmax(left <= tolerance)), 1) if swing_rad > 0.0 else 1, span)


def chebyshev_nodes(count: int, span: float = 1.0) -> np.ndarray:
    """Return so many Chebyshev instants of [0, span]."""
    return np.asarray(span * (0.5 - 0.5 * np.cos(np.pi * (np.arange(count) + 0.5) / count)))


def squint_swing_rad(setup: RadarSetup, paths: Paths) -> float:
    """Return half the two-way phase that the sweep adds across the array, largest over the paths."""
    array, wavelength_m = setup.array, setup.radar.wavelength_m
    across = np.abs(np.sin(paths.azimuth_rad) * np.cos(paths.elevation_rad))
    across += np.abs(np.sin(paths.departure_azimuth_rad) * np.cos(paths.departure_elevation_rad))
    up = np.abs(np.sin(paths.elevation_rad)) + np.abs(np.sin(paths.departure_elevation_rad))
    size_m = 0.5 * (array.columns - 1) * array.column_spacing(wavelength_m) * across
    size_m += 0.5 * (array.rows - 1) * array.row_spacing(wavelength_m) * up
    return float(np.pi * setup.radar.bandwidth_hz / SPEED_OF_LIGHT_MPS * size_m.max(initial=0.0))


def migration_swing_rad(radar: RadarParams, radial_speed_mps: np.ndarray) -> float:
    """Return half the phase by which the fastest path's Doppler differs over the sweep and the beam."""
    stretch = 2.0 * np.abs(radial_speed_mps).max(initial=0.0) / SPEED_OF_LIGHT_MPS
    turns = 0.5 * radar.bandwidth_hz * radar.beam_duration_s + (radar.carrier_hz + radar.bandwidth_hz) * (
        radar.chirp_period_s
    )
    return float(np.pi * stretch * turns)


def sweep_swing_rad(setup: RadarSetup, paths: Paths, effects: SignalEffects) -> float:
    """Return the bound of the phase swing of the slow factor over a whole sweep."""
    squint = squint_swing_rad(setup, paths) if effects.squint else 0.0
    migrates = effects.motion and effects.range_migration
    return squint + (migration_swing_rad(setup.radar, paths.radial_speed_mps) if migrates else 0.0)


def check_precision(precision: str) -> None:
    """Raise ValueError for a precision that is not known."""
    if precision not in TOLERANCE:
        raise ValueError(f"precision must be one of {sorted(TOLERANCE)}, got {precision!r}")


def swept_echoes(
    setup: RadarSetup,
    paths: Paths,
    effects: SignalEffects,
    front_end: FrontEnd,
    beams: slice = slice(None),
    precision: str = "float64",
) -> SweptEchoes:
    """Return the echoes of a scene at rest (Doppler left out), one row per beam; ValueError: unknown precision."""
    check_precision(precision)
    factors = _Factors(setup, paths, effects, front_end, beams)
    swing_rad = sweep_swing_rad(setup, paths, effects)
    kind = np.complex64 if precision == "float32" else np.complex128
    return sweep(
        setup.radar,
        paths.length_m,
        swing_rad,
        effects.chirp_overlap,
        lambda instants: factors.weights(instants, kind),
        precision,
    )


def single_echoes(
    setup: RadarSetup, paths: Paths, effects: SignalEffects, front_end: FrontEnd, beams: slice = slice(None)
) -> SweptEchoes:
    """Return the same in single precision, patterns and all, to 2e-6 of an echo at the array's peak."""
    factors, swing_rad = _Factors(setup, paths, effects, front_end, beams), sweep_swing_rad(setup, paths, effects)
    return sweep(setup.radar, paths.length_m, swing_rad, effects.chirp_overlap, factors.single, "float32")


class _Factors:
    """Slow factor of every echo: the antenna's conj(B_t B_r) at an instant of the chirp."""

    def __init__(
        self, setup: RadarSetup, paths: Paths, effects: SignalEffects, front_end: FrontEnd, beams: slice
    ) -> None:
        self.setup = setup if effects.element_pattern else isotropic(setup)
        self.paths, self.effects = paths, effects
        self._columns = column_weights(setup, effects, front_end)[beams]
        self.beams = len(self._columns)
        self._delay_s = paths.length_m / SPEED_OF_LIGHT_MPS
        self._out = departure(paths)

    def since_sent_s(self, share: float, previous: bool) -> np.ndarray:
        """Return t - tau at an instant of the chirp, from the start of the chirp that the echo belongs to."""
        return (share + previous) * self.setup.radar.chirp_period_s - self._delay_s

    def at(self, share: float, previous: bool) -> np.ndarray:
        """Return the recorded pattern of all beams at an instant of the chirp, complex128 [beams, P]."""
        radar, paths = self.setup.radar, self.paths
        ratio = sweep_ratio(radar, self.since_sent_s(share, previous)) if self.effects.squint else 1.0
        pattern = two_way_pattern(
            self.setup, self._columns, paths.azimuth_rad, paths.elevation_rad, *self._out, frequency_ratio=ratio
        )
        return np.conj(pattern)

    def weights(self, instants: list[tuple[float, bool]], kind: type) -> np.ndarray:
        """Return the recorded weights at instants (share of the chirp, previous chirp's?), [instants, beams, P]."""
        recorded = {previous: self.recorded(previous) for previous in (False, True)}
        values: np.ndarray = np.empty((len(instants), self.beams, len(self.paths)), kind)
        for index, (share, previous) in enumerate(instants):
            values[index] = self.at(share, previous) * recorded[previous]
        return values

    def single(self, instants: list[tuple[float, bool]]) -> np.ndarray:
        """Return the same in single precision, complex64."""
        (setup, paths), radar, columns = (self.setup, self.paths), self.setup.radar, self._columns
        array, wavelength_m = setup.array, radar.wavelength_m
        spacing_m = np.array([array.column_spacing(wavelength_m), array.row_spacing(wavelength_m)])
        directions = (
            (paths.azimuth_rad, paths.elevation_rad),
            (paths.departure_azimuth_rad, paths.departure_elevation_rad),
        )
        gain = np.prod([element_field(setup.element, *direction) for direction in directions], axis=0)
        ratio = np.ones((len(instants), len(paths)))
        if self.effects.squint:
            ratio = sweep_ratio(radar, np.stack([self.since_sent_s(*instant) for instant in instants]))
        out = np.empty((len(instants), self.beams, len(paths)), np.complex64)
        _fill_patterns(
            out,
            (np.ascontiguousarray(columns.T.real, np.float32), np.ascontiguousarray(columns.T.imag, np.float32)),
            2.0 * np.pi / wavelength_m * spacing_m,
            array.rows,
            array.steered_ways != 1,
            np.stack([np.sin(azimuth) * np.cos(elevation) for azimuth, elevation in directions]),
            np.stack([np.sin(elevation) for _, elevation in directions]),
            np.stack([self.recorded(previous) * gain for previous in (False, True)]),
            np.array([previous for _, previous in instants], np.int64),
            ratio,
        )
        return out

    def recorded(self, previous: bool) -> np.ndarray:
        """Return what is constant along the chirp: conj(W), turned by the beat's phase; complex128 [P]."""
        radar, length_m = self.setup.radar, self.paths.length_m
        if not previous:
            return np.conj(self.paths.amplitude) * np.exp(1j * beat_phase_rad(radar, length_m))
        length_m = previous_length_m(radar, length_m)
        passes = sampled(radar, beat_frequency_hz(radar, length_m))
        return np.conj(self.paths.amplitude) * passes * np.exp(1j * beat_phase_rad(radar, length_m))


def sweep(
    radar: RadarParams,
    length_m: np.ndarray,
    swing_rad: float,
    overlaps: bool,
    values: Callable[[list[tuple[float, bool]]], np.ndarray],
    precision: str,
) -> SweptEchoes:
    """Return echoes of a slow factor of such a swing, of `values` [instants, R, P] at (share, previous chirp's?)."""
    head_samples = int(overlap_samples(radar, length_m).max(initial=0)) if overlaps else 0
    span = -(-head_samples // CHUNK) * CHUNK / radar.samples_per_chirp
    tolerance = TOLERANCE[precision]
    instants = chebyshev_instants(swing_rad, tolerance)
    head = chebyshev_instants(swing_rad * span, tolerance, span) if head_samples else np.zeros(0)
    # the chirp's own echo over the chirp and over its start, then the previous chirp's over the start
    weights = values([(share, False) for share in (*instants, *head)] + [(share, True) for share in head])
    own, previous = len(instants), len(instants) + len(head)
    return SweptEchoes(
        radar=radar,
        length_m=length_m,
        instants=instants,
        weights=weights[:own],
        head_samples=head_samples,
        head_span=span,
        head_instants=head,
        head_own=weights[own:previous],
        head_previous=weights[previous:],
        swing_rad=swing_rad,
        precision=precision,
    )


def overlap_correction(echoes: SweptEchoes) -> np.ndarray:
    """Return the samples to add at the chirp's start: previous chirp's echo less this one's, for t < tau; [R, head].

    Paths by delay: in every chunk the active ones come first, one matrix product each.
    """
    radar = echoes.radar
    out = np.zeros((echoes.weights.shape[1], echoes.head_samples), echoes.weights.dtype)
    if not echoes.head_samples:
        return out
    ends = overlap_samples(radar, echoes.length_m)
    order = np.argsort(-ends, kind="stable")
    ends, length_m = ends[order], echoes.length_m[order]
    _add_head(out, echoes, -echoes.head_own[:, :, order], length_m, ends)
    _add_head(out, echoes, echoes.head_previous[:, :, order], previous_length_m(radar, length_m), ends)
    return out


def _add_head(
    out: np.ndarray, echoes: SweptEchoes, weights: np.ndarray, length_m: np.ndarray, ends: np.ndarray
) -> None:
    """Add tones that stop at their own sample, `ends` falling; weights [head instants, R, P]."""
    count, (instants, rows, _) = echoes.radar.samples_per_chirp, weights.shape
    cycles = beat_frequency_hz(echoes.radar, length_m) / echoes.radar.sample_rate_hz
    fine = _stepped_tones(cycles, CHUNK).astype(weights.dtype)
    local = chebyshev_instants(echoes.swing_rad * CHUNK / count, TOLERANCE[echoes.precision], CHUNK / count)
    slow = cardinal_functions(local, np.arange(CHUNK) / count, CHUNK / count).astype(fine.real.dtype)
    turns = _head_turns(instants, len(local), echoes.head_span, count, fine.real.dtype)
    for first in range(0, echoes.head_samples, CHUNK):
        size = min(CHUNK, echoes.head_samples - first)
        active, whole = np.searchsorted(-ends, [-first, -(first + size - 1)])
        tones = fine[:active, :size] * _tones(cycles[:active], np.array([first])).astype(fine.dtype)
        tones[whole:] *= first + np.arange(size) < ends[whole:active, None]
        here = turns[first // CHUNK].astype(fine.dtype) @ weights[:, :, :active].reshape(instants, -1)
        sums = (here.reshape(len(local) * rows, active) @ tones).reshape(len(local), rows, size)
        out[:, first : first + size] += np.einsum("krn,kn->rn", sums, slow[:, :size])


@lru_cache(maxsize=64)
def _head_turns(instants: int, local: int, span: float, count: int, kind: np.dtype) -> list[np.ndarray]:
    """Return the polynomials of so many instants of a start at those of each of its chunks, [local, instants] each."""
    here, there = chebyshev_nodes(instants, span), chebyshev_nodes(local, CHUNK / count)
    starts = range(0, round(span * count), CHUNK)
    return [cardinal_functions(here, there + first / count, span).astype(kind).T for first in starts]


def _tones(cycles_per_sample: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """Return exp(2 pi j x n), complex128 [tones, samples]."""
    return np.exp(2j * np.pi * (np.multiply.outer(cycles_per_sample, sample) % 1.0))


def _stepped_tones(cycles_per_sample: np.ndarray, count: int) -> np.ndarray:
    """Return exp(2 pi j x n) for n < count, a multiple of 8: coarse steps times fine ones, few exponentials."""
    coarse, fine = _tones(cycles_per_sample, np.arange(0, count, 8)), _tones(cycles_per_sample, np.arange(8))
    return (coarse[:, :, None] * fine[:, None]).reshape(len(coarse), count)


@compiled(fastmath=True)
def _fill_patterns(out, weights, steps, rows, both, across, up, recorded, previous, ratio):  # type: ignore[no-untyped-def]
    """Write recorded two-way patterns, conj(B B') times what is constant along the chirp; out [instants, B, P]."""
    weights_re, weights_im = weights
    instants, beams, paths = out.shape
    re, im = np.empty(beams, np.float32), np.empty(beams, np.float32)
    out_re, out_im = np.empty(beams, np.float32), np.empty(beams, np.float32)
    for path in range(paths):
        alike = across[0, path] == across[1, path] and up[0, path] == up[1, path]
        for index in range(instants):
            at = ratio[index, path]
            one_way(weights_re, weights_im, steps, rows, at * across[0, path], at * up[0, path], re, im)
            out_re[:], out_im[:] = re, im
            if both and not alike:
                one_way(weights_re, weights_im, steps, rows, at * across[1, path], at * up[1, path], out_re, out_im)
            factor = recorded[previous[index], path]
            for beam in range(beams):
                a, b = re[beam], im[beam]
                if both:
                    a, b = a * out_re[beam] - b * out_im[beam], a * out_im[beam] + b * out_re[beam]
                out[index, beam, path] = np.complex64(complex(a, -b) * factor)


@compiled(fastmath=True)
def one_way(weights_re, weights_im, steps, rows, across, up, out_re, out_im):  # type: ignore[no-untyped-def]
    """Fill in the one-way pattern of all beams, as `models.physics.antenna.one_way_pattern` without the element."""
    columns, beams = weights_re.shape
    turn, tilt = steps[0] * across, steps[1] * up
    row = 0.0
    for index in range(rows):
        row += np.cos(tilt * (index - 0.5 * (rows - 1)))
    scale = row / np.sqrt(rows * columns)
    angle = -0.5 * turn * (columns - 1)
    phase_re, phase_im = scale * np.cos(angle), scale * np.sin(angle)
    step_re, step_im = np.cos(turn), np.sin(turn)
    out_re[:], out_im[:] = 0.0, 0.0
    for column in range(columns):
        re, im = np.float32(phase_re), np.float32(phase_im)
        for beam in range(beams):
            out_re[beam] += weights_re[column, beam] * re - weights_im[column, beam] * im
            out_im[beam] += weights_re[column, beam] * im + weights_im[column, beam] * re
        phase_re, phase_im = phase_re * step_re - phase_im * step_im, phase_re * step_im + phase_im * step_re
