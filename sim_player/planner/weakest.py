"""What a scene in motion can do without, by magnitudes alone: no phase is asked, so it holds while everything moves.

From one instant of tracing to the next (`sim_player.paths.path_tracks`) the field of a path stays under the larger of
its two ends, its direction and its range between them; one that comes or goes is carried on by its rate. So the weakest
paths go as long as their magnitudes, added up without phases, stay in every range bin of every beam under what may
change (`sim_player.planner.choice`), whatever else stands there; a map keeps the budget too, whichever instants its
beams are from.

A choice holds to the next instant of tracing, where paths are known that are not yet known here. What is not weak over
a whole span is kept, so a path that comes into view is there from the instant before. Labels are those of everything.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from models.compiled import compiled
from models.physics.antenna import element_field
from models.physics.waveform import beat_frequency_hz
from msgs.values.radar import ArrayParams, ElementPattern, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.planner.choice import Limit
from sim_player.planner.evaluation import hann_skirt, head_area, head_height
from sim_player.planner.purposes import Purpose
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.levels import RANGE_BINS
from sim_player.signal.switches import SignalEffects, column_weights, isotropic
from sim_player.trace.path_table import Paths

#: Range bins to either side in which the skirts of the window count one by one; beyond, a path has the same in all, and
#: all of these together this share of what is allowed.
REACH, FAR_SHARE = 12, 0.1
#: The window's skirts of an echo whose pattern squints over those of a steady one as strong as its strongest instant;
#: measured are 1.57 at most, in the nulls of a beam.
SQUINTED = 1.6
#: Steps of the table of patterns in the sine of an angle, for each column of the array; sine of the table's ends.
STEPS_PER_COLUMN, WIDEST_SINE = 64, 1.2
#: The cubic through two ends and their slopes leaves the line between them by this share of what they miss it by.
CUBIC = 4.0 / 27.0


@dataclass(frozen=True)
class Span:
    """Paths between two instants, P of them in B beams: a bound of the field of each, float32 [P, B].

    First and last range bin of each, int64 [P]; what its overlapped start changes nearby and far off (`_heads`), [P].
    """

    magnitude: np.ndarray
    low: np.ndarray
    high: np.ndarray
    area: np.ndarray
    far: np.ndarray


class Weakest:
    """Choice of the paths that are kept between two instants, for one radar, purpose and budget (a field ratio)."""

    def __init__(
        self, setup: RadarSetup, effects: SignalEffects, front_end: FrontEnd, purpose: Purpose, budget: float
    ) -> None:
        self._setup, self._radar, self._effects = setup, setup.radar, effects
        self._element = (setup if effects.element_pattern else isotropic(setup)).element
        weights = column_weights(setup, effects, front_end)
        self._patterns = _pattern_table(setup.array, setup.radar.wavelength_m, weights.shape, weights.tobytes())
        self._limit = Limit(setup, effects, front_end, purpose, budget).each_beam
        self._skirt = np.minimum(SQUINTED * hann_skirt(setup.radar, REACH), 1.0).astype(np.float32)
        self._band = 0.5 * setup.radar.bandwidth_hz / setup.radar.carrier_hz

    def kept(self, first: Paths, last: Paths, step_s: float) -> np.ndarray:
        """Return which paths are kept from one instant to the next, bool [P]; `first` and `last` are the same ones.

        Raises ValueError for paths that are not, or not finite.
        """
        span = self.span(first, last, step_s)
        strength = span.magnitude.max(axis=1, initial=0.0)
        # most are asked no further: alone they are too strong where they stand
        weak = np.flatnonzero(strength * (self._skirt[0] + span.area) <= self._limit.max())
        if not len(weak):
            return np.ones(len(strength), bool)
        order = weak[np.argsort(strength[weak], kind="stable")]
        return np.asarray(
            _strongest(span.magnitude, span.low, span.high, order, self._limit, self._skirt, span.area, span.far)
        )

    def span(self, first: Paths, last: Paths, step_s: float = 1.0) -> Span:
        """Return what bounds the paths from one instant to the next."""
        _check(first, last)
        ends = _ends(first, last)
        amplitude = np.maximum(np.abs(first.amplitude), np.abs(last.amplitude))
        for direction in ends:
            amplitude = amplitude * _element_most(self._element, direction)
        amplitude = amplitude.astype(np.float32)
        steered = ends if self._setup.array.steered_ways != 1 else ends[:1]
        length_m = np.maximum(first.length_m, last.length_m)
        delay_s = length_m / SPEED_OF_LIGHT_MPS
        # the sweep scales what the array sees of a direction (`sweep_ratio`)
        least, most = 1.0 - self._band - self._late(delay_s), 1.0 + self._band
        return Span(
            _most(self._patterns, amplitude, steered, least, most),
            *self._visited(first, last, step_s),
            *self._heads(length_m),
        )

    def _late(self, delay_s: np.ndarray) -> np.ndarray:
        """Return how far the frequency that comes in is below the one sent, relative, [P]."""
        return np.asarray(self._radar.chirp_slope_hz_per_s * delay_s / self._radar.carrier_hz)

    def _visited(self, first: Paths, last: Paths, step_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the first and the last range bin that a path's tone comes near, int64 [P] each."""
        radar = self._radar
        ends_m = np.stack([first.length_m, last.length_m])
        rise_m = ends_m[1] - ends_m[0]
        missed_m = sum(np.abs(2.0 * step_s * end.radial_speed_mps - rise_m) for end in (first, last))
        fastest_mps = np.maximum(np.abs(first.radial_speed_mps), np.abs(last.radial_speed_mps)) + missed_m / step_s
        # within a beam it moves on, and Doppler shifts the beat
        more = fastest_mps * (
            radar.beam_duration_s / radar.range_bin_m + 2.0 * radar.chirp_period_s / radar.wavelength_m
        )
        tone = beat_frequency_hz(radar, ends_m) * radar.chirp_period_s
        more = more + beat_frequency_hz(radar, CUBIC * missed_m) * radar.chirp_period_s
        low, high = np.rint(tone.min(axis=0) - more), np.rint(tone.max(axis=0) + more)
        ends = np.clip(np.stack([low, high]), 0, RANGE_BINS + REACH - 1).astype(np.int64)
        return ends[0], ends[1]

    def _heads(self, length_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what the overlapped start of echoes changes in the bins nearby, and what it and the window's skirts
        leave farther off; of a unit echo, float32 [P] each.

        The start of the chirp is cut off the echo, and the last chirp's takes its place a band away: neither is more
        than the window there. Summed by parts, what is cut falls as 1 / off.
        """
        radar, count = self._radar, self._radar.samples_per_chirp
        share = np.minimum(length_m / SPEED_OF_LIGHT_MPS / radar.chirp_period_s + 2.0 / count, 1.0)
        area, height = head_area(share), head_height(share)
        off = np.arange(-RANGE_BINS, RANGE_BINS + REACH + 1) - radar.bandwidth_hz * radar.chirp_period_s
        closest = count * float(np.abs(np.sin(np.pi * off / count)).min())
        far = np.minimum(area, height / (2.0 * math.pi * REACH)) + np.minimum(area, height / max(2.0 * closest, 1.0))
        beyond = length_m > 2.0 * (RANGE_BINS + REACH) * radar.range_bin_m
        far = np.where(beyond, 2.0 * area, far)
        # nearby is what is cut off, and what takes its place from afar
        return (area + far).astype(np.float32), (far + self._skirt[-1]).astype(np.float32)


def _check(first: Paths, last: Paths) -> None:
    if not np.array_equal(first.chain, last.chain):
        raise ValueError(f"ends of a span must hold the same paths in the same order, got {len(first)} and {len(last)}")
    for end in (first, last):
        parts = (end.length_m, end.radial_speed_mps, np.abs(end.amplitude), *_directions(end))
        # a sum of all is finite where each is
        if not math.isfinite(total := float(sum(part.sum() for part in parts))):
            raise ValueError(f"paths of a span must be finite, got {total!r}")


def _directions(paths: Paths) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuth and elevation of arrival and of departure, [2, P] each."""
    return (
        np.stack([paths.azimuth_rad, paths.elevation_rad]),
        np.stack([paths.departure_azimuth_rad, paths.departure_elevation_rad]),
    )


def _ends(first: Paths, last: Paths) -> np.ndarray:
    """Return directions of arrival and of departure at both ends, [2, ends, 2, P]."""
    return np.array([np.stack(ends) for ends in zip(_directions(first), _directions(last), strict=True)])


def _element_most(element: ElementPattern, ends: np.ndarray) -> np.ndarray:
    """Return the largest field of an element between two directions [ends, 2, P], [P]: it falls off its axis."""
    (first, last), nearest = ends, np.abs(ends).min(axis=0)
    nearest[(first * last < 0.0) & (np.abs(first - last) <= np.pi)] = 0.0
    return np.asarray(element_field(element, *nearest))


@lru_cache(maxsize=8)
def _pattern_table(array: ArrayParams, wavelength_m: float, shape: tuple[int, int], weights: bytes) -> np.ndarray:
    """Return the largest one-way pattern of each beam, elements left out, from each step of the sine over the next
    2^level; float32 [levels, steps, B]. `weights` are complex128 [B, columns].
    """
    columns = np.frombuffer(weights, np.complex128).reshape(shape)
    count = STEPS_PER_COLUMN * array.columns
    sine = np.linspace(-WIDEST_SINE, WIDEST_SINE, count)
    turn_rad = (
        2.0
        * np.pi
        / wavelength_m
        * array.column_spacing(wavelength_m)
        * (np.arange(array.columns) - 0.5 * (array.columns - 1))
    )
    # between two steps it stands above both by the curvature of the fastest phase at most
    bent = 0.5 * (0.5 * turn_rad[-1] * (sine[1] - sine[0])) ** 2
    scaled = math.sqrt(array.rows / array.columns) * columns
    waves = np.exp(1j * np.outer(sine, turn_rad))
    table = [np.abs(waves @ scaled.T) + bent * np.abs(scaled).sum(axis=1)]
    while 2 ** len(table) <= count:
        half = 2 ** (len(table) - 1)
        later = np.concatenate([table[-1][half:], np.repeat(table[-1][-1:], half, axis=0)])
        table.append(np.maximum(table[-1], later))
    return np.array(table, np.float32)


@compiled
def _most(patterns, amplitude, directions, least, most):  # type: ignore[no-untyped-def]
    """Products of the amplitudes [P] and the largest patterns between directions [1 or 2, ends, 2, P], scaled by
    `least` [P] to `most`; float32 [P, B].
    """
    steps, beams = patterns.shape[1:]
    scale = (steps - 1) / (2.0 * WIDEST_SINE)
    out = np.empty((len(amplitude), beams), np.float32)
    for path in range(len(amplitude)):
        out[path] = amplitude[path]
        if amplitude[path] == 0.0:
            continue
        for ends in directions:
            level, begin, end = _steps(ends[:, :, path], least[path], most, scale, steps)
            former, latter = patterns[level, begin], patterns[level, end]
            for beam in range(beams):
                out[path, beam] *= max(former[beam], latter[beam])
    return out


@compiled
def _steps(ends, least, most, scale, steps):  # type: ignore[no-untyped-def]
    """Return the level of the table that covers a path's sines in two places, and these."""
    low, high = _sines(ends)
    low *= most if low < 0.0 else least
    high *= most if high > 0.0 else least
    begin = max(int(np.floor((low + WIDEST_SINE) * scale)), 0)
    end = min(int(np.ceil((high + WIDEST_SINE) * scale)), steps - 1)
    level = 0
    while 2 ** (level + 1) <= end - begin + 1:
        level += 1
    return level, begin, end - 2**level + 1


@compiled
def _sines(ends):  # type: ignore[no-untyped-def]
    """Least and largest sin(azimuth) cos(elevation) between two directions [ends, 2], by the shorter way round."""
    first, up, last_up = ends[0, 0], ends[0, 1], ends[1, 1]
    last = first + (ends[1, 0] - first + np.pi) % (2.0 * np.pi) - np.pi
    low, high = min(np.sin(first), np.sin(last)), max(np.sin(first), np.sin(last))
    # past the side of the array its sine has an end of its own
    side = 0.5 * np.pi
    if np.floor((first - side) / (2.0 * np.pi)) != np.floor((last - side) / (2.0 * np.pi)):
        high = 1.0
    if np.floor((first + side) / (2.0 * np.pi)) != np.floor((last + side) / (2.0 * np.pi)):
        low = -1.0
    narrow = min(np.cos(up), np.cos(last_up))
    wide = 1.0 if up * last_up <= 0.0 else max(np.cos(up), np.cos(last_up))
    return low * (wide if low < 0.0 else narrow), high * (wide if high > 0.0 else narrow)


@compiled(fastmath=True)
def _strongest(magnitude, low, high, order, limit, skirt, area, far):  # type: ignore[no-untyped-def]
    """Mask of the paths that stay once the weakest have gone that fit the limits [bins] in all beams, bool [P]."""
    bins, beams = len(limit), magnitude.shape[1]
    near_limit, far_limit = (1.0 - FAR_SHARE) * limit, FAR_SHARE * limit.min()
    near, everywhere = np.zeros((bins, beams), np.float32), np.zeros(beams, np.float32)
    more = np.empty(beams, np.float32)
    kept = np.ones(len(magnitude), np.bool_)
    for path in order:
        begin, end = max(low[path] - REACH, 0), min(high[path] + REACH + 1, bins)
        cut, away = area[path], far[path]
        most = 0.0
        for beam in range(beams):
            most = max(most, everywhere[beam] + away * magnitude[path, beam])
        fits = most <= far_limit
        for cell in range(begin, end):
            factor = skirt[max(low[path] - cell, cell - high[path], 0)] + cut
            most = 0.0
            for beam in range(beams):
                most = max(most, near[cell, beam] + factor * magnitude[path, beam])
            if most > near_limit[cell]:
                fits = False
                break
        if not fits:
            continue
        kept[path] = False
        for beam in range(beams):
            more[beam] = magnitude[path, beam]
            everywhere[beam] += away * more[beam]
        for cell in range(begin, end):
            factor = skirt[max(low[path] - cell, cell - high[path], 0)] + cut
            for beam in range(beams):
                near[cell, beam] += factor * more[beam]
    return kept
