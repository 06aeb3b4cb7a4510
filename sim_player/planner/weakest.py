"""What a scene can do without, by magnitudes alone: no phase is asked, so it holds while everything moves.

From one instant of tracing to the next (`sim_player.paths.path_tracks`) the field of a path stays under the larger of
its two ends, its direction and its range between them; one that comes or goes is carried on by its rate. A scene at
rest has one instant, which is both ends. So the weakest paths go as long as their magnitudes, added up without phases,
stay in every range bin of every beam under a share of

    budget x (noise rms for `samples`, more for `peaks` and `objects`: `sim_player.planner.purposes`),

whatever else stands there. In the same way paths are taken without squint, as in the middle of the sweep all the way,
and without overlap, as if the chirp before had left no echo. The shares are such that a map keeps the budget too,
whichever instants its beams are from.

A choice holds to the next instant of tracing, where paths are known that are not yet known here. What is not weak over
a whole span is kept, so a path that comes into view is there from the instant before. Paths that make truth points
(`sim_player.paths.truth`) are kept whatever their size: labels are those of everything.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from models.compiled import compiled
from models.physics.antenna import element_field
from models.physics.waveform import beat_frequency_hz, window_noise_gain
from msgs.values.radar import ArrayParams, ElementPattern, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS, ratio_from_db
from sim_player.paths.truth import VISIBLE_SNR_DB, labelled
from sim_player.planner.cells import cells_of
from sim_player.planner.evaluation import hann_skirt, head_area, head_height, skirt
from sim_player.planner.purposes import LEAST, Purpose
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.levels import RANGE_BINS, noise_rms
from sim_player.signal.receiver import iq_factors
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
#: Sum of the terms along the sweep of what squint changes, over the largest of it.
TERMS = np.float32(1.4)
#: The cubic through two ends and their slopes leaves the line between them by this share of what they miss it by.
CUBIC = 4.0 / 27.0
#: Shares of the budget: of paths that go, of those without squint, of those without overlap, of all weights that go.
#: The errors of an evaluated map have what is left. In motion paths that go have all of it.
PATH_SHARE, SQUINT_SHARE, OVERLAP_SHARE, WEIGHT_SHARE = 0.3, 0.15, 0.15, 0.05
#: What two steps have of each other beyond their sum: a path without squint overlaps by another pattern, some percent.
INFLATION = 1.02
#: What a beat in single precision misses in a range bin, of the sum of its echoes at the array's peak.
SINGLE = 3e-6
#: A truth point may be so much weaker here than where it is judged, where columns couple.
TRUTH_MARGIN = 0.7


@dataclass(frozen=True)
class Choice:
    """Paths that are kept, and those of them that squint and that overlap, bool [P]; the share of the budget spent."""

    kept: np.ndarray
    squints: np.ndarray
    overlaps: np.ndarray
    spent: float


@dataclass(frozen=True)
class Span:
    """Paths between two instants, P of them in B beams: a bound of the field of each, float32 [P, B]; the same of one
    element [P]; directions of arrival and departure, those that are steered, [1 or 2, ends, 2, P].

    First and last range bin of each, int64 [P]; what its overlapped start changes nearby and far off (`_heads`), [P].
    """

    magnitude: np.ndarray
    amplitude: np.ndarray
    steered: np.ndarray
    low: np.ndarray
    high: np.ndarray
    area: np.ndarray
    far: np.ndarray
    delay_s: np.ndarray

    @cached_property
    def strength(self) -> np.ndarray:
        """The largest field of each path in any beam, [P]."""
        return np.asarray(self.magnitude.max(axis=1, initial=0.0))


class Weakest:
    """Choice of the paths that are kept between two instants, for one radar, purpose and budget (a field ratio)."""

    def __init__(
        self, setup: RadarSetup, effects: SignalEffects, front_end: FrontEnd, purpose: Purpose, budget: float
    ) -> None:
        self._setup, self._radar, self._effects = setup, setup.radar, effects
        self._element = (setup if effects.element_pattern else isotropic(setup)).element
        weights = column_weights(setup, effects, front_end)
        self._patterns, self._slopes = _pattern_tables(
            setup.array, setup.radar.wavelength_m, weights.shape, weights.tobytes()
        )
        gain = INFLATION * max(sum(abs(factor) for factor in iq_factors(front_end)), 1.0)
        rms = noise_rms(setup, effects, front_end)
        #: The most that all changes may add up to in a range bin of any beam, [bins].
        self.limit = budget * LEAST[purpose] / gain * cells_of(setup).map_share * rms
        self._skirt = np.minimum(SQUINTED * hann_skirt(setup.radar, REACH), 1.0).astype(np.float32)
        one_side = skirt(setup.radar, RANGE_BINS)
        self._any_skirt = one_side[len(one_side) // 2 :][: REACH + 1].astype(np.float32)
        visible = TRUTH_MARGIN**2 * ratio_from_db(VISIBLE_SNR_DB) / window_noise_gain("hann")
        self._visible = math.sqrt(visible * float(np.median(np.square(rms))))
        self._band = 0.5 * setup.radar.bandwidth_hz / setup.radar.carrier_hz

    def kept(self, first: Paths, last: Paths, step_s: float) -> np.ndarray:
        """Return which paths are kept from one instant to the next, bool [P]; `first` and `last` are the same ones.

        Raises ValueError for paths that are not, or not finite.
        """
        return self._kept(first, self.span(first, last, step_s), 1.0)[0]

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
            amplitude,
            steered,
            *self._visited(first, last, step_s),
            *self._heads(length_m),
            delay_s,
        )

    def choose(self, first: Paths, span: Span) -> Choice:
        """Return what is kept of each path of a span that begins with some paths."""
        kept, spent = self._kept(first, span, PATH_SHARE)
        squints, overlaps = np.zeros_like(kept), np.zeros_like(kept)
        without = replace(span, far=span.far - self._skirt[-1])
        if self._effects.chirp_overlap:
            no_skirts = np.zeros_like(self._skirt)
            overlaps, more = self._weakest(span.magnitude, without, OVERLAP_SHARE, no_skirts, kept)
            overlaps, spent = overlaps & kept, spent + more
        if self._effects.squint:
            # what overlaps does so by another pattern
            swept = replace(without, far=without.far + self._any_skirt[-1])
            squints, more = self._weakest(self._turned(span), swept, SQUINT_SHARE, self._any_skirt, kept)
            squints, spent = squints & kept, spent + more
        return Choice(kept, squints, overlaps, spent)

    def rounding(self, span: Span, kept: np.ndarray) -> float:
        """Return what beats of the kept paths in single precision miss at most, as a share of the budget."""
        array = self._setup.array
        peak = float(array.columns * array.rows) ** (1.0 if array.steered_ways != 1 else 0.5)
        return SINGLE * peak * float(span.amplitude[kept].sum() / self.limit.min())

    def _kept(self, first: Paths, span: Span, share: float) -> tuple[np.ndarray, float]:
        """Return the paths that are kept, bool [P], and what the others spend of the budget, a share at most."""
        truth = labelled(first) & ((first.object_index >= 0) | (span.strength >= self._visible))
        return self._weakest(span.magnitude, span, share, self._skirt, ~truth)

    def fits(self, span: Span, change: np.ndarray, parts: int) -> bool:
        """Return whether all paths may change by a share of their field [P], together within 1 / parts of
        `WEIGHT_SHARE`.
        """
        share = WEIGHT_SHARE / parts
        # one of them may say no for all
        if float((change * span.strength).max(initial=0.0)) > share * float(self.limit.max()):
            return False
        # as large as single precision can say: a path of nothing changes by any factor
        magnitude = span.magnitude * np.minimum(change, 1e30)[:, None].astype(np.float32)
        return not self._weakest(magnitude, span, share, self._skirt, np.ones(len(change), bool))[0].any()

    def _weakest(
        self, magnitude: np.ndarray, span: Span, share: float, skirts: np.ndarray, may_go: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Return which paths stay, bool [P], once the weakest have gone that fit a share, and how much that spends."""
        strength, limit = magnitude.max(axis=1, initial=0.0), share * self.limit
        # most are asked no further: alone they are too strong where they stand
        weak = np.flatnonzero(may_go & (strength * (skirts[0] + span.area) <= limit.max()))
        if not len(weak):
            return np.ones(len(strength), bool), 0.0
        order = weak[np.argsort(strength[weak], kind="stable")]
        kept, used = _strongest(magnitude, span.low, span.high, order, limit, skirts, span.area, span.far)
        return kept, share * float(used)

    def _late(self, delay_s: np.ndarray) -> np.ndarray:
        """Return how far the frequency that comes in is below the one sent, relative, [P]."""
        return np.asarray(self._radar.chirp_slope_hz_per_s * delay_s / self._radar.carrier_hz)

    def _turned(self, span: Span) -> np.ndarray:
        """Return a bound of what squint changes of each path in each beam, as the sum of its terms; float32 [P, B].

        A one-way pattern that the sweep carries by its sine times what the frequency is off changes by no more than its
        steepest slope there; so do the rows, by the rms way of their elements.
        """
        array, wavelength_m = self._setup.array, self._radar.wavelength_m
        off = self._band + self._late(span.delay_s)
        rows_m = array.row_spacing(wavelength_m) * math.sqrt((array.rows**2 - 1) / 12.0)
        tilted = sum(_widest_sine(direction[:, 1]) for direction in span.steered) * (
            2.0 * math.pi / wavelength_m * rows_m
        )
        least = 1.0 - off
        return np.asarray(
            _most_turned(
                self._patterns,
                self._slopes,
                span.amplitude,
                span.steered,
                (least, 1.0 + self._band),
                (off, off * tilted),
            )
        )

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


def _widest_sine(ends: np.ndarray) -> np.ndarray:
    """Return the largest |sine| of an angle between two, [ends, P], [P]."""
    sides = np.prod(np.cos(ends), axis=0) <= 0.0
    return np.asarray(np.where(sides, 1.0, np.abs(np.sin(ends)).max(axis=0)))


def _element_most(element: ElementPattern, ends: np.ndarray) -> np.ndarray:
    """Return the largest field of an element between two directions [ends, 2, P], [P]: it falls off its axis."""
    (first, last), nearest = ends, np.abs(ends).min(axis=0)
    nearest[(first * last < 0.0) & (np.abs(first - last) <= np.pi)] = 0.0
    return np.asarray(element_field(element, *nearest))


@lru_cache(maxsize=8)
def _pattern_tables(
    array: ArrayParams, wavelength_m: float, shape: tuple[int, int], weights: bytes
) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest one-way pattern of each beam, elements left out, and its steepest slope over the sine, from
    each step of the sine over the next 2^level; float32 [levels, steps, B]. `weights` are complex128 [B, columns].
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
    tables = []
    for of_columns in (scaled, scaled * turn_rad):
        lowest = np.abs(waves @ of_columns.T) + bent * np.abs(of_columns).sum(axis=1)
        table = [lowest]
        while 2 ** len(table) <= count:
            half = 2 ** (len(table) - 1)
            later = np.concatenate([table[-1][half:], np.repeat(table[-1][-1:], half, axis=0)])
            table.append(np.maximum(table[-1], later))
        tables.append(np.array(table, np.float32))
    return tables[0], tables[1]


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
            level, begin, end, _ = _steps(ends[:, :, path], least[path], most, scale, steps)
            former, latter = patterns[level, begin], patterns[level, end]
            for beam in range(beams):
                out[path, beam] *= max(former[beam], latter[beam])
    return out


@compiled
def _steps(ends, least, most, scale, steps):  # type: ignore[no-untyped-def]
    """Return the level of the table that covers a path's sines in two places, these, and the widest sine."""
    low, high = _sines(ends)
    low *= most if low < 0.0 else least
    high *= most if high > 0.0 else least
    begin = max(int(np.floor((low + WIDEST_SINE) * scale)), 0)
    end = min(int(np.ceil((high + WIDEST_SINE) * scale)), steps - 1)
    level = 0
    while 2 ** (level + 1) <= end - begin + 1:
        level += 1
    return level, begin, end - 2**level + 1, max(abs(low), abs(high))


@compiled(fastmath=True)
def _most_turned(patterns, slopes, amplitude, directions, ratios, off):  # type: ignore[no-untyped-def]
    """What the sweep changes at most, as the sum of its terms: products of the amplitudes [P] and the change of one
    pattern times the other's most, and the rows' of both; `off` by [P], and by rows [P]; float32 [P, B].
    """
    (least, most), (columns_off, rows_off) = ratios, off
    steps, beams = patterns.shape[1:]
    scale = (steps - 1) / (2.0 * WIDEST_SINE)
    out = np.zeros((len(amplitude), beams), np.float32)
    whole, change = np.empty(beams, np.float32), np.empty(beams, np.float32)
    for path in range(len(amplitude)):
        if amplitude[path] == 0.0:
            continue
        whole[:], change[:] = 1.0, 0.0
        for ends in directions:
            level, begin, end, widest = _steps(ends[:, :, path], least[path], most, scale, steps)
            moved = np.float32(widest * columns_off[path])
            for beam in range(beams):
                here = max(patterns[level, begin, beam], patterns[level, end, beam])
                steep = max(slopes[level, begin, beam], slopes[level, end, beam])
                change[beam] = change[beam] * here + whole[beam] * min(moved * steep, 2.0 * here)
                whole[beam] *= here
        for beam in range(beams):
            turned = change[beam] + np.float32(rows_off[path]) * whole[beam]
            out[path, beam] = TERMS * amplitude[path] * min(turned, 2.0 * whole[beam])
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
    """Mask of the paths that stay once the weakest have gone that fit the limits [bins] in all beams, bool [P]; and the
    largest share of a limit that is spent.
    """
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
    worst, away = 0.0, 0.0
    for beam in range(beams):
        away = max(away, everywhere[beam])
    for cell in range(bins):
        most = 0.0
        for beam in range(beams):
            most = max(most, near[cell, beam])
        worst = max(worst, (most + away) / limit[cell])
    return kept, worst
