"""What a moving scene can do without between two instants of tracing, by magnitudes alone.

In motion phases turn within a wavelength, so no evaluation of one instant bounds the next. From one instant of tracing
to the next (`sim_player.trace.path_tracks`) everything else is bounded: the field of a path stays under the larger of
its two ends, its direction and its range between them; one that comes or goes is carried on by its rate. So the weakest
paths go as long as their magnitudes, added up without phases, stay in every range bin of every beam under a share of

    budget x (noise rms for `samples`, detection threshold for `peaks` and `objects`),

whatever else stands there. The share is such that a map keeps the budget too, whichever instants its beams are from.

That is how far a selection holds: to the next instant of tracing, where paths are known that are not yet known here.
What is not weak over a whole span is kept, so a path that comes into view is there from the instant before.
"""

from __future__ import annotations

import math

import numpy as np

from models.compiled import compiled
from models.physics.antenna import element_field
from models.physics.waveform import beat_frequency_hz
from msgs.values.radar import ElementPattern, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.planner.ablation import INFLATION
from sim_player.planner.cells import cells_of
from sim_player.planner.evaluation import hann_skirt, head_area, head_height
from sim_player.planner.purposes import Purpose
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.levels import RANGE_BINS, noise_rms
from sim_player.signal.receiver import iq_factors
from sim_player.signal.switches import SignalEffects, column_weights, isotropic
from sim_player.trace.paths import Paths

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


class SpanSelection:
    """Selection of the paths that are kept between two instants, for one radar, purpose and budget (a field ratio)."""

    def __init__(
        self, setup: RadarSetup, effects: SignalEffects, front_end: FrontEnd, purpose: Purpose, budget: float
    ) -> None:
        self._setup, self._radar = setup, setup.radar
        self._element = (setup if effects.element_pattern else isotropic(setup)).element
        self._patterns = _pattern_table(setup, column_weights(setup, effects, front_end))
        cells, shape = cells_of(setup), (len(setup.beams), RANGE_BINS)
        gain = INFLATION * max(sum(abs(factor) for factor in iq_factors(front_end)), 1.0)
        reference = cells.floor(np.zeros(shape, np.complex64), noise_rms(setup, effects, front_end), purpose=purpose)
        self._limit = budget / gain * (reference / cells.bounds(np.ones(shape))).min(axis=0)
        self._skirt = np.minimum(SQUINTED * hann_skirt(setup.radar, REACH), 1.0).astype(np.float32)

    def kept(self, first: Paths, last: Paths, step_s: float) -> np.ndarray:
        """Return which paths are kept from one instant to the next, bool [P]; `first` and `last` are the same ones.

        Raises ValueError for paths that are not, or not finite.
        """
        _check(first, last)
        magnitude, (low, high) = self.magnitude(first, last), self._visited(first, last, step_s)
        area, far = self._heads(np.maximum(first.length_m, last.length_m))
        order = np.argsort(magnitude.max(axis=1, initial=0.0), kind="stable")
        return np.asarray(_strongest(magnitude, low, high, order, self._limit, self._skirt, area, far))

    def magnitude(self, first: Paths, last: Paths) -> np.ndarray:
        """Return a bound of the field of each path in each beam from one instant to the next, float32 [P, B]."""
        radar = self._radar
        directions = np.array([np.stack(ends) for ends in zip(_directions(first), _directions(last), strict=True)])
        amplitude = np.maximum(np.abs(first.amplitude), np.abs(last.amplitude))
        for ends in directions:
            amplitude = amplitude * _element_most(self._element, ends)
        steered = directions if self._setup.array.steered_ways != 1 else directions[:1]
        # the sweep scales what the array sees of a direction (`sweep_ratio`)
        band = 0.5 * radar.bandwidth_hz / radar.carrier_hz
        delay_s = np.maximum(first.length_m, last.length_m) / SPEED_OF_LIGHT_MPS
        least = 1.0 - band - radar.chirp_slope_hz_per_s * delay_s / radar.carrier_hz
        return np.asarray(_most(self._patterns, amplitude.astype(np.float32), steered, least, 1.0 + band))

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
        far = np.where(beyond, 2.0 * area, far) + self._skirt[-1]
        return (2.0 * area).astype(np.float32), far.astype(np.float32)


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


def _element_most(element: ElementPattern, ends: np.ndarray) -> np.ndarray:
    """Return the largest field of an element between two directions [ends, 2, P], [P]: it falls off its axis."""
    (first, last), nearest = ends, np.abs(ends).min(axis=0)
    nearest[(first * last < 0.0) & (np.abs(first - last) <= np.pi)] = 0.0
    return np.asarray(element_field(element, *nearest))


def _pattern_table(setup: RadarSetup, weights: np.ndarray) -> np.ndarray:
    """Return the largest one-way pattern of each beam, elements left out, from each step of the sine over the next
    2^level; float32 [levels, steps, B].
    """
    array, wavelength_m = setup.array, setup.radar.wavelength_m
    count = STEPS_PER_COLUMN * array.columns
    sine = np.linspace(-WIDEST_SINE, WIDEST_SINE, count)
    step_rad = 2.0 * np.pi / wavelength_m * array.column_spacing(wavelength_m)
    position = np.arange(array.columns) - 0.5 * (array.columns - 1)
    scale = math.sqrt(array.rows / array.columns)
    table = [np.abs(np.exp(1j * step_rad * np.outer(sine, position)) @ weights.T) * scale]
    # between two steps it stands above both by the curvature of the fastest phase at most
    turn_rad = 0.5 * step_rad * position[-1] * (sine[1] - sine[0])
    table[0] += 0.5 * turn_rad**2 * scale * np.abs(weights).sum(axis=1)
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
            low, high = _sines(ends[:, :, path])
            low *= most if low < 0.0 else least[path]
            high *= most if high > 0.0 else least[path]
            begin = max(int(np.floor((low + WIDEST_SINE) * scale)), 0)
            end = min(int(np.ceil((high + WIDEST_SINE) * scale)), steps - 1)
            level = 0
            while 2 ** (level + 1) <= end - begin + 1:
                level += 1
            former, latter = patterns[level, begin], patterns[level, end - 2**level + 1]
            for beam in range(beams):
                out[path, beam] *= max(former[beam], latter[beam])
    return out


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
    """Mask of the paths that stay once the weakest have gone that fit the limits [bins] in all beams; bool [P]."""
    bins, beams = len(limit), magnitude.shape[1]
    near_limit, far_limit = (1.0 - FAR_SHARE) * limit, FAR_SHARE * limit.min()
    near, everywhere = np.zeros((bins, beams), np.float32), np.zeros(beams, np.float32)
    more = np.empty(beams, np.float32)
    kept = np.ones(len(order), np.bool_)
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
