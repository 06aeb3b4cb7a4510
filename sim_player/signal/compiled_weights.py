"""Recorded weights of all echoes of a beam at instants of the sweep, compiled: antenna, beat, Doppler in few terms.

The slow factor of an echo, conj(B_t B_r W) e^{j beat phase} with its Doppler, at instants counted in chirps from the
start of the echo's own chirp. What the previous chirp leaves at the start of this one is the same factor a chirp
later, but for a constant of each path and a phase that moves by 1e-4 rad (`previous_chirp`).
"""

from __future__ import annotations

import numpy as np

from models.compiled import compiled
from models.physics.antenna import element_field
from models.physics.waveform import beat_frequency_hz, beat_phase_rad, doppler_turn_rad
from msgs.values.radar import RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.fmcw import slow_time_table
from sim_player.signal.switches import SignalEffects, column_weights, isotropic, previous_length_m, sampled
from sim_player.trace.paths import Paths

#: Paths that the compiled loops work on at a time.
BLOCK = 256
#: Rows of the table of paths: delay [chirps], turn [rad a chirp], constant factor, phases across columns and rows
#: [rad] of arrival and departure.
_DELAY, _TURN, _RE, _IM, _ACROSS_IN, _UP_IN, _ACROSS_OUT, _UP_OUT = range(8)


class EchoWeights:
    """Recorded weights of P echoes of one beam in R slow-time terms."""

    def __init__(self, setup: RadarSetup, paths: Paths, effects: SignalEffects, front_end: FrontEnd, beam: int) -> None:
        radar, array = setup.radar, setup.array
        self._radar, self._paths = radar, paths
        self._columns = column_weights(setup, effects, front_end)[beam] / np.sqrt(array.columns)
        self._rows, self._steered_ways = array.rows, array.steered_ways
        speed = paths.radial_speed_mps if effects.motion else np.zeros(len(paths))
        self._turn = doppler_turn_rad(radar, speed)
        sweep = radar.bandwidth_hz / radar.carrier_hz
        self._squint = sweep if effects.squint else 0.0
        migrates = effects.motion and effects.range_migration
        self._migration = (sweep, 1.0) if migrates else (0.0, 0.0)
        # along the sweep a migrating path's Doppler follows the frequency
        self._slow = slow_time_table(radar, self._turn, 1.0 + sweep * (1.0 if effects.range_migration else 0.0))
        self._delay = paths.length_m / SPEED_OF_LIGHT_MPS / radar.chirp_period_s
        self._phase_rad = beat_phase_rad(radar, paths.length_m)
        self._table = self._of_paths(setup if effects.element_pattern else isotropic(setup))

    @property
    def carrier(self) -> np.ndarray:
        """Common phase of all chirps, complex128 [chirps]."""
        return self._slow.carrier

    @property
    def basis(self) -> np.ndarray:
        """Terms over the chirps, float64 [R, chirps]."""
        return self._slow.basis

    def at(self, instants: np.ndarray) -> np.ndarray:
        """Return the weights at instants [K] in chirps; float32 [2, K, R, P], real parts first."""
        slow = self._slow
        out = np.empty((2, len(instants), len(slow.basis), len(self._paths)), np.float32)
        place = np.array([slow.middle_rad, 1.0 / slow.widest_rad if slow.widest_rad else 0.0, *self._migration])
        array = (np.conj(self._columns), self._rows, self._steered_ways)
        _weigh(out, self._table, instants, self._squint, array, slow.series, place)
        return out

    def previous_chirp(self) -> tuple[np.ndarray, np.ndarray]:
        """Return what turns the weights of instant x + 1 into the previous chirp's at x: start and slope; [P] each.

        Factor start (1 + slope x), complex128. Zero where the low pass takes the previous chirp's beat.
        """
        length_m = previous_length_m(self._radar, self._paths.length_m)
        passes = sampled(self._radar, beat_frequency_hz(self._radar, length_m))
        sweep, share = self._migration
        # the distance moved counts from the start of this chirp, not of the one before
        moved_rad = -share * self._turn * (1.0 + sweep * (1.0 - self._delay))
        start = passes * np.exp(1j * (beat_phase_rad(self._radar, length_m) - self._phase_rad + moved_rad))
        return start, -1j * share * sweep * self._turn

    def _of_paths(self, setup: RadarSetup) -> np.ndarray:
        """Return the table of paths, float64 [8, P]."""
        paths, array, wavelength_m = self._paths, setup.array, setup.radar.wavelength_m
        across = 2.0 * np.pi / wavelength_m * array.column_spacing(wavelength_m)
        up = 2.0 * np.pi / wavelength_m * array.row_spacing(wavelength_m)
        factor = np.conj(paths.amplitude) * np.exp(1j * self._phase_rad)
        phases = []
        for azimuth_rad, elevation_rad in (
            (paths.azimuth_rad, paths.elevation_rad),
            (paths.departure_azimuth_rad, paths.departure_elevation_rad),
        ):
            factor = factor * element_field(setup.element, azimuth_rad, elevation_rad)
            phases += [across * np.sin(azimuth_rad) * np.cos(elevation_rad), up * np.sin(elevation_rad)]
        return np.stack([self._delay, self._turn, factor.real, factor.imag, *phases])


@compiled(error_model="numpy", fastmath=True)
def _weigh(out, table, instants, squint, array, series, place):  # type: ignore[no-untyped-def]
    columns, rows, steered_ways = array
    paths = table.shape[1]
    ratio, turn, re, im = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    scratch = np.empty((4, BLOCK))
    middle, scale, sweep, share = place
    for first in range(0, paths, BLOCK):
        end = min(first + BLOCK, paths)
        size = end - first
        # rows of their own: compiled loops need them without strides
        delay, own_turn = table[_DELAY][first:end], table[_TURN][first:end]
        own_re, own_im = table[_RE][first:end], table[_IM][first:end]
        for k in range(len(instants)):
            x = instants[k]
            for p in range(size):
                since = x - delay[p]
                ratio[p] = 1.0 + squint * (since - 0.5)
                turn[p] = own_turn[p] * (1.0 + sweep * since)
                re[p], im[p] = own_re[p], own_im[p]
            _times_columns(re, im, columns, table[_ACROSS_IN][first:end], ratio, scratch)
            _times_rows(re, im, rows, table[_UP_IN][first:end], ratio)
            if steered_ways == 2:
                _times_columns(re, im, columns, table[_ACROSS_OUT][first:end], ratio, scratch)
                _times_rows(re, im, rows, table[_UP_OUT][first:end], ratio)
            if share != 0.0:
                # the distance moved since the chirp's start
                for p in range(size):
                    sine, cosine = _sine_cosine(turn[p] * x * share)
                    a, b = re[p], im[p]
                    re[p], im[p] = a * cosine - b * sine, a * sine + b * cosine
            for p in range(size):
                turn[p] = (turn[p] - middle) * scale
            for r in range(len(series)):
                _write_term(out[0, k, r][first:end], out[1, k, r][first:end], re, im, series[r], turn, scratch)


@compiled(error_model="numpy", fastmath=True)
def _sine_cosine(x):  # type: ignore[no-untyped-def]
    """Return sine and cosine to 1e-9, for loops of many lanes."""
    quarter = np.rint(x * (2.0 / np.pi))
    r = x - quarter * (0.5 * np.pi)
    q = quarter - 4.0 * np.floor(0.25 * quarter)
    s = r * r
    sine = r * (1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0 * (1.0 - s / 110.0)))))
    cosine = 1.0 - s / 2.0 * (1.0 - s / 12.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0 * (1.0 - s / 90.0))))
    swap = q == 1.0 or q == 3.0
    a = cosine if swap else sine
    b = sine if swap else cosine
    return (-a if q >= 2.0 else a), (-b if q == 1.0 or q == 2.0 else b)


@compiled(error_model="numpy", fastmath=True)
def _times_columns(re, im, weights, phase_rad, ratio, scratch):  # type: ignore[no-untyped-def]
    """Multiply by conj(sum_m w_m exp(j (m - (M - 1) / 2) phase ratio)), of conjugated weights; elements centred."""
    size, last = len(phase_rad), len(weights) - 1
    cosine, sine, sum_re, sum_im = scratch[0], scratch[1], scratch[2], scratch[3]
    for p in range(size):
        # the conjugate of the sum turns the other way
        sine[p], cosine[p] = _sine_cosine(-phase_rad[p] * ratio[p])
        sum_re[p], sum_im[p] = weights[last].real, weights[last].imag
    for m in range(last - 1, -1, -1):
        w_re, w_im = weights[m].real, weights[m].imag
        for p in range(size):
            a, b, c, s = sum_re[p], sum_im[p], cosine[p], sine[p]
            sum_re[p], sum_im[p] = a * c - b * s + w_re, a * s + b * c + w_im
    for p in range(size):
        s, c = _sine_cosine(0.5 * last * phase_rad[p] * ratio[p])
        a, b = sum_re[p] * c - sum_im[p] * s, sum_re[p] * s + sum_im[p] * c
        f, g = re[p], im[p]
        re[p], im[p] = f * a - g * b, f * b + g * a


@compiled(error_model="numpy", fastmath=True)
def _times_rows(re, im, rows, phase_rad, ratio):  # type: ignore[no-untyped-def]
    """Multiply by the sum of rows of one weight, sum_m cos((m - (M - 1) / 2) phase ratio) / sqrt(M)."""
    scale, odd = 2.0 / np.sqrt(rows), rows % 2
    for p in range(len(phase_rad)):
        _, half = _sine_cosine(0.5 * phase_rad[p] * ratio[p])
        twice = 2.0 * (2.0 * half * half - 1.0)
        # cosines of 0, 1, ... or 1/2, 3/2, ... steps, by their recurrence
        before, now = (0.5 * twice, 1.0) if odd else (half, half)
        total = -0.5 if odd else 0.0
        for _ in range((rows + 1) // 2):
            total += now
            before, now = now, twice * now - before
        re[p] *= total * scale
        im[p] *= total * scale


@compiled(error_model="numpy", fastmath=True)
def _write_term(out_re, out_im, re, im, series, place, scratch):  # type: ignore[no-untyped-def]
    """Write a factor times the share of one slow-time term, a Chebyshev series in `place`."""
    b_re, b_im, d_re, d_im = scratch[0], scratch[1], scratch[2], scratch[3]
    size = len(out_re)
    for p in range(size):
        b_re[p], b_im[p], d_re[p], d_im[p] = 0.0, 0.0, 0.0, 0.0
    # Clenshaw, four powers a time: a quarter of the way to memory and back
    last = len(series) - 1
    for q in range(last, 3, -4):
        s0, s1, s2, s3 = series[q], series[q - 1], series[q - 2], series[q - 3]
        for p in range(size):
            twice = 2.0 * place[p]
            x0, y0 = twice * b_re[p] - d_re[p] + s0.real, twice * b_im[p] - d_im[p] + s0.imag
            x1, y1 = twice * x0 - b_re[p] + s1.real, twice * y0 - b_im[p] + s1.imag
            x2, y2 = twice * x1 - x0 + s2.real, twice * y1 - y0 + s2.imag
            b_re[p], b_im[p] = twice * x2 - x1 + s3.real, twice * y2 - y1 + s3.imag
            d_re[p], d_im[p] = x2, y2
    for q in range(last % 4, 0, -1):
        a, b = series[q].real, series[q].imag
        for p in range(size):
            new_re, new_im = 2.0 * place[p] * b_re[p] - d_re[p] + a, 2.0 * place[p] * b_im[p] - d_im[p] + b
            d_re[p], d_im[p], b_re[p], b_im[p] = b_re[p], b_im[p], new_re, new_im
    a, b = series[0].real, series[0].imag
    for p in range(size):
        s_re, s_im = place[p] * b_re[p] - d_re[p] + a, place[p] * b_im[p] - d_im[p] + b
        out_re[p] = re[p] * s_re - im[p] * s_im
        out_im[p] = re[p] * s_im + im[p] * s_re
