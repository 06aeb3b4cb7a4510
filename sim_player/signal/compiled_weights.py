"""Recorded weights of all echoes of a beam at instants of the sweep, compiled: antenna, beat, Doppler in few terms.

conj(B_t B_r W) e^{j beat phase} with its Doppler, at instants in chirps from the echo's own; the previous chirp's
factor is the same a chirp later, but for a constant and a phase that moves by 1e-4 rad (`previous_chirp`).
"""

from __future__ import annotations

import numpy as np

from models.compiled import compiled
from models.physics.antenna import element_field
from models.physics.waveform import beat_frequency_hz, beat_phase_rad, doppler_turn_rad
from msgs.values.radar import RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.fmcw import SlowTimeTable
from sim_player.signal.switches import SignalEffects, column_weights, isotropic, previous_length_m, sampled
from sim_player.trace.path_table import Paths

#: Paths that the compiled loops work on at a time.
BLOCK = 256
#: Rows of the table of paths: length [m], delay [chirps], turn [rad a chirp], constant factor, phases across columns
#: and rows [rad] of arrival and departure.
_LENGTH, _DELAY, _TURN, _RE, _IM, _ACROSS_IN, _UP_IN, _ACROSS_OUT, _UP_OUT = range(9)


class EchoWeights:
    """Recorded weights of the echoes of one beam in R slow-time terms, at instants [K] in chirps.

    Without echoes under `tolerance` of the strongest, shared by all. `weights` [2, K, R, P], real parts first, longest
    first; `rows` [P] says which are left.
    """

    def __init__(
        self,
        setup: RadarSetup,
        group: tuple[Paths, SignalEffects],
        front_end: FrontEnd,
        beam: int,
        slow: SlowTimeTable,
        instants: np.ndarray,
        tolerance: float,
        kind: type,
    ) -> None:
        (paths, effects), array = group, setup.array
        self._radar, self._slow, self._kind = setup.radar, slow, kind
        columns = np.conj(column_weights(setup, effects, front_end)[beam] / np.sqrt(array.columns))
        self._array = columns, array.rows, array.steered_ways
        sweep = setup.radar.bandwidth_hz / setup.radar.carrier_hz
        self._squint = sweep if effects.squint else 0.0
        # along the sweep a migrating path's Doppler follows the frequency
        self._migration = (sweep, 1.0) if effects.motion and effects.range_migration else (0.0, 0.0)
        table = _table(setup if effects.element_pattern else isotropic(setup), paths, effects.motion)
        # nothing comes from behind
        order = np.argsort(-paths.length_m, kind="stable")
        order = order[(table[_RE] != 0.0)[order] | (table[_IM] != 0.0)[order]]
        self._table = table.take(order, axis=1)
        factors, power = self._factors(instants)
        heard = np.flatnonzero(power > (tolerance / max(len(paths), 1)) ** 2 * power.max(initial=0.0))
        self.rows, self._table = order[heard], self._table.take(heard, axis=1)
        self.weights = self._in_terms(factors.take(heard, axis=2), instants)

    @property
    def length_m(self) -> np.ndarray:
        """Round trips, [P]."""
        return self._table[_LENGTH]

    def at(self, instants: np.ndarray) -> np.ndarray:
        """Return the weights of the same echoes at other instants."""
        return self._in_terms(self._factors(instants)[0], instants)

    def previous_chirp(self) -> tuple[np.ndarray, np.ndarray]:
        """Return what turns weights of instant x + 1 into the previous chirp's at x: start (1 + slope x), [P] each.

        Zero where the low pass takes the previous chirp's beat.
        """
        radar, own_m, turn = self._radar, self.length_m, self._table[_TURN]
        length_m = previous_length_m(radar, own_m)
        passes = sampled(radar, beat_frequency_hz(radar, length_m))
        sweep, share = self._migration
        # the distance moved counts from the start of this chirp, not of the one before
        moved_rad = -share * turn * (1.0 + sweep * (1.0 - self._table[_DELAY]))
        phase_rad = beat_phase_rad(radar, length_m) - beat_phase_rad(radar, own_m)
        return passes * np.exp(1j * (phase_rad + moved_rad)), -1j * share * sweep * turn

    def _factors(self, instants: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the factors without the terms of slow time, float64 [2, K, P], and their largest power [P]."""
        out, power = np.empty((2, len(instants), self._table.shape[1])), np.zeros(self._table.shape[1])
        _weigh(out, power, self._table, instants, self._squint, self._array, np.array(self._migration))
        return out, power

    def _in_terms(self, factors: np.ndarray, instants: np.ndarray) -> np.ndarray:
        slow, (_, count, paths) = self._slow, factors.shape
        out: np.ndarray = np.empty((2, count, len(slow.series), paths), self._kind)
        place = np.array([slow.middle_rad, 1.0 / slow.widest_rad if slow.widest_rad else 0.0, self._migration[0]])
        _write_terms(out, factors, self._table, instants, slow.series, place)
        return out


def _table(setup: RadarSetup, paths: Paths, moves: bool) -> np.ndarray:
    """Return the table of paths, float64 [9, P]."""
    radar, array, wavelength_m = setup.radar, setup.array, setup.radar.wavelength_m
    across = 2.0 * np.pi / wavelength_m * array.column_spacing(wavelength_m)
    up = 2.0 * np.pi / wavelength_m * array.row_spacing(wavelength_m)
    factor = np.conj(paths.amplitude) * np.exp(1j * beat_phase_rad(radar, paths.length_m))
    phases = []
    for azimuth_rad, elevation_rad in (
        (paths.azimuth_rad, paths.elevation_rad),
        (paths.departure_azimuth_rad, paths.departure_elevation_rad),
    ):
        factor = factor * element_field(setup.element, azimuth_rad, elevation_rad)
        phases += [across * np.sin(azimuth_rad) * np.cos(elevation_rad), up * np.sin(elevation_rad)]
    delay = paths.length_m / SPEED_OF_LIGHT_MPS / radar.chirp_period_s
    turn = doppler_turn_rad(radar, paths.radial_speed_mps) if moves else np.zeros(len(paths))
    return np.stack([paths.length_m, delay, turn, factor.real, factor.imag, *phases])


@compiled(error_model="numpy", fastmath=True)
def _weigh(out, power, table, instants, squint, array, migration):  # type: ignore[no-untyped-def]
    columns, rows, steered_ways = array
    paths = table.shape[1]
    ratio, scratch = np.empty(BLOCK), np.empty((4, BLOCK))
    sweep, share = migration
    for first in range(0, paths, BLOCK):
        end = min(first + BLOCK, paths)
        size = end - first
        # rows of their own: compiled loops need them without strides
        delay, own_turn = table[_DELAY][first:end], table[_TURN][first:end]
        own_re, own_im = table[_RE][first:end], table[_IM][first:end]
        for k in range(len(instants)):
            x = instants[k]
            re, im = out[0, k][first:end], out[1, k][first:end]
            for p in range(size):
                ratio[p] = 1.0 + squint * (x - delay[p] - 0.5)
                re[p], im[p] = own_re[p], own_im[p]
            _times_columns(re, im, columns, table[_ACROSS_IN][first:end], ratio, scratch)
            _times_rows(re, im, rows, table[_UP_IN][first:end], ratio)
            if steered_ways == 2:
                _times_columns(re, im, columns, table[_ACROSS_OUT][first:end], ratio, scratch)
                _times_rows(re, im, rows, table[_UP_OUT][first:end], ratio)
            if share != 0.0:
                # the distance moved since the chirp's start
                for p in range(size):
                    sine, cosine = sine_cosine(own_turn[p] * (1.0 + sweep * (x - delay[p])) * x * share)
                    a, b = re[p], im[p]
                    re[p], im[p] = a * cosine - b * sine, a * sine + b * cosine
            most = power[first:end]
            for p in range(size):
                most[p] = max(most[p], re[p] * re[p] + im[p] * im[p])


@compiled(error_model="numpy", fastmath=True)
def _write_terms(out, factors, table, instants, series, place):  # type: ignore[no-untyped-def]
    """Write factors times their shares of the terms (`SlowTimeTable.series`)."""
    middle, scale, sweep = place
    paths = table.shape[1]
    at, twice, b, d = np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK), np.empty(BLOCK)
    for first in range(0, paths, BLOCK):
        end = min(first + BLOCK, paths)
        size = end - first
        delay, turn = table[_DELAY][first:end], table[_TURN][first:end]
        for k in range(len(instants)):
            re, im = factors[0, k][first:end], factors[1, k][first:end]
            for p in range(size):
                at[p] = (turn[p] * (1.0 + sweep * (instants[k] - delay[p])) - middle) * scale
                twice[p] = 4.0 * at[p] * at[p] - 2.0
            for r in range(len(series)):
                out_re, out_im = out[0, k, r][first:end], out[1, k, r][first:end]
                # Clenshaw
                for p in range(size):
                    b[p], d[p] = 0.0, 0.0
                for q in range(series.shape[1] - 1, 0, -1):
                    power = series[r, q]
                    for p in range(size):
                        b[p], d[p] = twice[p] * b[p] - d[p] + power, b[p]
                power = series[r, 0]
                if r % 2:
                    for p in range(size):
                        share = at[p] * (0.5 * twice[p] * b[p] - d[p] + power)
                        out_re[p], out_im[p] = -share * im[p], share * re[p]
                else:
                    for p in range(size):
                        share = 0.5 * twice[p] * b[p] - d[p] + power
                        out_re[p], out_im[p] = share * re[p], share * im[p]


@compiled(error_model="numpy", fastmath=True)
def sine_cosine(x):  # type: ignore[no-untyped-def]
    """Return sine and cosine to 1e-12, for loops of many lanes."""
    quarter = np.rint(x * (2.0 / np.pi))
    r = x - quarter * (0.5 * np.pi)
    q = quarter - 4.0 * np.floor(0.25 * quarter)
    s = r * r
    sine = s / 42.0 * (1.0 - s / 72.0 * (1.0 - s / 110.0 * (1.0 - s / 156.0)))
    cosine = s / 30.0 * (1.0 - s / 56.0 * (1.0 - s / 90.0 * (1.0 - s / 132.0 * (1.0 - s / 182.0))))
    sine, cosine = (
        r * (1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - sine))),
        1.0 - s / 2.0 * (1.0 - s / 12.0 * (1.0 - cosine)),
    )
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
        sine[p], cosine[p] = sine_cosine(-phase_rad[p] * ratio[p])
        sum_re[p], sum_im[p] = weights[last].real, weights[last].imag
    for m in range(last - 1, -1, -1):
        w_re, w_im = weights[m].real, weights[m].imag
        for p in range(size):
            a, b, c, s = sum_re[p], sum_im[p], cosine[p], sine[p]
            sum_re[p], sum_im[p] = a * c - b * s + w_re, a * s + b * c + w_im
    for p in range(size):
        s, c = sine_cosine(0.5 * last * phase_rad[p] * ratio[p])
        a, b = sum_re[p] * c - sum_im[p] * s, sum_re[p] * s + sum_im[p] * c
        f, g = re[p], im[p]
        re[p], im[p] = f * a - g * b, f * b + g * a


@compiled(error_model="numpy", fastmath=True)
def _times_rows(re, im, rows, phase_rad, ratio):  # type: ignore[no-untyped-def]
    """Multiply by the sum of rows of one weight, sum_m cos((m - (M - 1) / 2) phase ratio) / sqrt(M)."""
    scale, odd = 2.0 / np.sqrt(rows), rows % 2
    for p in range(len(phase_rad)):
        _, half = sine_cosine(0.5 * phase_rad[p] * ratio[p])
        twice = 2.0 * (2.0 * half * half - 1.0)
        # cosines of 0, 1, ... or 1/2, 3/2, ... steps, by their recurrence
        before, now = (0.5 * twice, 1.0) if odd else (half, half)
        total = -0.5 if odd else 0.0
        for _ in range((rows + 1) // 2):
            total += now
            before, now = now, twice * now - before
        re[p] *= total * scale
        im[p] *= total * scale
