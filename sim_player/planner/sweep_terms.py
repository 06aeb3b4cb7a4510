"""Patterns along the sweep in as few terms as each path needs, with a bound of what the terms leave out.

An echo's factor along the chirp (squint) is a band-limited function of the sweep: c_0 + c_1 T_1 + ... in Chebyshev
polynomials. A phase that swings by +-alpha is interpolated at K points to 4 (J_K(alpha) + J_K+1(alpha) + ...) of the
array's peak. The weakest paths need no term, weak ones need one, the strongest seven.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from models.compiled import compiled
from models.physics.antenna import element_field
from models.physics.waveform import beat_frequency_hz, beat_phase_rad
from msgs.values.array_table import ArrayTable
from msgs.values.radar import RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.swept_echoes import one_way
from sim_player.signal.switches import SignalEffects, column_weights, isotropic, overlap_samples, sweep_ratio
from sim_player.trace.path_table import Paths

MAX_TERMS = 12


@dataclass(frozen=True)
class SweepTerms(ArrayTable):
    """P echoes as recorded, beat phase included: terms along the sweep and mid-sweep values, in sqrt(mW)."""

    #: Complex64 [P, most terms, B] and [P, B].
    terms: np.ndarray
    middle: np.ndarray
    #: Number of terms, and what they leave out at most in any beam, [P]: all of an echo without terms.
    count: np.ndarray
    remainder: np.ndarray
    #: The field at the array's peak, [P].
    full: np.ndarray
    #: Tone in range bins, share of the chirp that still belongs to the last one, half the phase swing, [P].
    tone: np.ndarray
    head: np.ndarray
    swing_rad: np.ndarray

    @cached_property
    def magnitudes(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of each echo, and of what the sweep adds to its middle, in each beam; float32 [P, B] each."""
        return _magnitudes(self.terms, self.middle, self.count, self.remainder)


def sweep_terms(
    setup: RadarSetup,
    paths: Paths,
    effects: SignalEffects,
    front_end: FrontEnd,
    tolerance: float | np.ndarray,
) -> SweepTerms:
    """Return the echoes with their pattern along the sweep to a tolerance in sqrt(mW), one for all or [P]."""
    radar, array = setup.radar, setup.array
    wavelength_m = radar.wavelength_m
    directions = (
        (paths.azimuth_rad, paths.elevation_rad),
        (paths.departure_azimuth_rad, paths.departure_elevation_rad),
    )
    across = np.stack([np.sin(a) * np.cos(e) for a, e in directions])
    up = np.stack([np.sin(e) for _, e in directions])
    element = (setup if effects.element_pattern else isotropic(setup)).element
    gain = np.prod([element_field(element, a, e) for a, e in directions], axis=0)
    both = array.steered_ways != 1
    swing_rad = np.pi * radar.bandwidth_hz / SPEED_OF_LIGHT_MPS * _reach_m(setup, across, up, both)
    full = gain * np.abs(paths.amplitude) * float(array.columns * array.rows) ** (1.0 if both else 0.5)
    swept_rad = swing_rad * effects.squint
    count, remainder = _needed(full, swept_rad, np.broadcast_to(tolerance, len(paths)))
    weights = column_weights(setup, effects, front_end)
    recorded = np.conj(paths.amplitude) * np.exp(1j * beat_phase_rad(radar, paths.length_m)) * gain
    delay_s = paths.length_m / SPEED_OF_LIGHT_MPS
    centre = sweep_ratio(radar, 0.5 * radar.chirp_period_s - delay_s) if effects.squint else np.ones(len(paths))
    overlap = overlap_samples(radar, paths.length_m) if effects.chirp_overlap else np.zeros(len(paths))
    terms, middle = _fill_terms(
        np.ascontiguousarray(weights.T.real, np.float32),
        np.ascontiguousarray(weights.T.imag, np.float32),
        2.0 * np.pi / wavelength_m * np.array([array.column_spacing(wavelength_m), array.row_spacing(wavelength_m)]),
        array.rows,
        both,
        across,
        up,
        recorded,
        centre,
        0.5 * radar.bandwidth_hz / radar.carrier_hz,
        count,
        _nodes(),
        _transforms(),
    )
    tone = beat_frequency_hz(radar, paths.length_m) * radar.chirp_period_s
    head = overlap / radar.samples_per_chirp
    return SweepTerms(terms, middle, count, remainder, full, tone, head, swing_rad)


def _reach_m(setup: RadarSetup, across: np.ndarray, up: np.ndarray, both: bool) -> np.ndarray:
    """Return half the array's extent along each path's directions, out and back together, [P]."""
    array, wavelength_m = setup.array, setup.radar.wavelength_m
    across_m = 0.5 * (array.columns - 1) * array.column_spacing(wavelength_m)
    up_m = 0.5 * (array.rows - 1) * array.row_spacing(wavelength_m)
    steered = 2 if both else 1
    return np.asarray((across_m * np.abs(across[:steered]) + up_m * np.abs(up[:steered])).sum(axis=0))


@compiled
def _needed(full, swing_rad, tolerance):  # type: ignore[no-untyped-def]
    """Return the fewest terms that each path needs, int64 [P], and what they leave out at most, float32 [P].

    K terms leave out 4 (J_K + ...) of exp(j swing x), and J_k(a) < (a / 2)^k / k!; none leaves out all.
    """
    count, remainder = np.zeros(len(full), np.int64), full.astype(np.float32)
    for path in range(len(full)):
        if full[path] <= tolerance[path]:
            continue
        half, first = 0.5 * swing_rad[path], 1.0
        for terms in range(1, MAX_TERMS + 1):
            first *= half / terms
            left = 4.0 * first / max(1.0 - half / (terms + 1), 0.25)
            if half >= 0.75 * (terms + 1):
                left = 2.0
            count[path], remainder[path] = terms, min(left, 2.0) * full[path]
            if remainder[path] <= tolerance[path]:
                break
    return count, remainder


@lru_cache(maxsize=1)
def _nodes() -> np.ndarray:
    """Return the Chebyshev points of each number of terms, [terms + 1, points]."""
    nodes = np.zeros((MAX_TERMS + 1, MAX_TERMS))
    for count in range(1, MAX_TERMS + 1):
        nodes[count, :count] = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    return nodes


@lru_cache(maxsize=1)
def _transforms() -> np.ndarray:
    """Return the terms of values at those points, float32 [terms + 1, terms, points]: discrete cosine transforms."""
    transforms = np.zeros((MAX_TERMS + 1, MAX_TERMS, MAX_TERMS), np.float32)
    for count in range(1, MAX_TERMS + 1):
        table = np.polynomial.chebyshev.chebvander(_nodes()[count, :count], count - 1).T * (2.0 / count)
        table[0] *= 0.5
        transforms[count, :count, :count] = table
    return transforms


@compiled(fastmath=True)
def _fill_terms(  # type: ignore[no-untyped-def]
    weights_re, weights_im, steps, rows, both, across, up, recorded, centre, half_band, count, nodes, transforms
):
    """Patterns at the points of the sweep, turned into terms. Real and imaginary parts apart: loops over beams then
    run on vectors.
    """
    beams = weights_re.shape[1]
    paths = len(count)
    most = 1
    for path in range(paths):
        most = max(most, count[path])
    terms = np.zeros((paths, most, beams), np.complex64)
    middle = np.zeros((paths, beams), np.complex64)
    # the last one is the middle of the sweep
    values_re, values_im = np.empty((most + 1, beams), np.float32), np.empty((most + 1, beams), np.float32)
    re, im = np.empty(beams, np.float32), np.empty(beams, np.float32)
    sum_re, sum_im = np.empty(beams, np.float32), np.empty(beams, np.float32)
    for path in range(paths):
        if count[path] == 0:
            continue
        alike = across[0, path] == across[1, path] and up[0, path] == up[1, path]
        factor_re, factor_im = np.float32(recorded[path].real), np.float32(recorded[path].imag)
        for node in range(count[path] + 1):
            ratio = 1.0 if node == count[path] else centre[path] + half_band * nodes[count[path], node]
            value_re, value_im = values_re[node], values_im[node]
            one_way(weights_re, weights_im, steps, rows, ratio * across[0, path], ratio * up[0, path], re, im)
            if both:
                if alike:
                    sum_re[:], sum_im[:] = re, im
                else:
                    one_way(
                        weights_re,
                        weights_im,
                        steps,
                        rows,
                        ratio * across[1, path],
                        ratio * up[1, path],
                        sum_re,
                        sum_im,
                    )
                for beam in range(beams):
                    product_re = re[beam] * sum_re[beam] - im[beam] * sum_im[beam]
                    im[beam] = re[beam] * sum_im[beam] + im[beam] * sum_re[beam]
                    re[beam] = product_re
            # as recorded: the conjugate
            for beam in range(beams):
                value_re[beam] = factor_re * re[beam] + factor_im * im[beam]
                value_im[beam] = factor_im * re[beam] - factor_re * im[beam]
        for term in range(count[path]):
            sum_re[:], sum_im[:] = 0.0, 0.0
            for node in range(count[path]):
                share = transforms[count[path], term, node]
                for beam in range(beams):
                    sum_re[beam] += share * values_re[node, beam]
                    sum_im[beam] += share * values_im[node, beam]
            for beam in range(beams):
                terms[path, term, beam] = complex(sum_re[beam], sum_im[beam])
        for beam in range(beams):
            middle[path, beam] = complex(values_re[count[path], beam], values_im[count[path], beam])
    return terms, middle


@compiled(fastmath=True)
def _magnitudes(terms, middle, count, remainder):  # type: ignore[no-untyped-def]
    paths, _, beams = terms.shape
    whole, squint = np.empty((paths, beams), np.float32), np.empty((paths, beams), np.float32)
    for path in range(paths):
        for beam in range(beams):
            first = terms[path, 0, beam]
            off = first - middle[path, beam]  # both 0 without terms
            whole[path, beam] = remainder[path] + np.sqrt(first.real * first.real + first.imag * first.imag)
            squint[path, beam] = remainder[path] + np.sqrt(off.real * off.real + off.imag * off.imag)
        for term in range(1, count[path]):
            for beam in range(beams):
                off = terms[path, term, beam]
                more = np.sqrt(off.real * off.real + off.imag * off.imag)
                whole[path, beam] += more
                squint[path, beam] += more
    return whole, squint
