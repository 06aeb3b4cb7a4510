"""What each beam of a scene in motion can do without, by magnitudes alone: no phase is asked.

A beam hears few of the paths: two side lobes are 26 dB down or more. So each beam chooses for itself, at the instant at
which its paths are frozen (`sim_player.player`). The weakest paths go as long as their magnitudes, added up without
phases, stay in every range bin under what may change (`sim_player.planner.kept_paths`), whatever else stands there; in
the same way the overlap of others goes, which costs most. It holds in every range and Doppler bin, and a map keeps the
budget too, whichever times its beams are of. Labels are those of everything.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from models.compiled import compiled
from msgs.values.radar import ArrayParams, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.planner.evaluation import hann_skirt
from sim_player.planner.kept_paths import Limit
from sim_player.planner.purposes import Purpose
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.levels import RANGE_BINS
from sim_player.signal.switches import SignalEffects, column_weights, isotropic
from sim_player.trace.path_table import Paths

#: Range bins to either side in which the skirts of the window count one by one; beyond, a path has the same in all, and
#: all of these together this share of what is allowed.
REACH, FAR_SHARE = 12, 0.1
#: Share of the budget that the weakest paths may take; the overlap of others has what is left.
PATHS_SHARE = 0.7
#: The window's skirts of an echo whose pattern squints over those of a steady one as strong as its strongest instant;
#: measured are 1.57 at most, in the nulls of a beam.
SQUINTED = 1.6
#: Fewer paths cost less than the question which of them go.
FEWEST = 256
#: Steps of the table of patterns in the sine of an angle, for each column of the array; sine of the table's ends.
STEPS_PER_COLUMN, WIDEST_SINE = 64, 1.2
#: What `Weakest._asked` returns.
_Asked = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]


class Weakest:
    """Choice of the paths of one beam at one instant, for one radar, purpose and budget (a field ratio)."""

    def __init__(
        self, setup: RadarSetup, effects: SignalEffects, front_end: FrontEnd, purpose: Purpose, budget: float
    ) -> None:
        self._setup, self._effects = setup, effects
        element = (setup if effects.element_pattern else isotropic(setup)).element
        widths = math.radians(element.azimuth_hpbw_deg), math.radians(element.elevation_hpbw_deg)
        #: Field of an element ahead, its beamwidths, and its least level in dB.
        self._lobe = 10.0 ** (0.05 * element.peak_gain_dbi), *widths, element.sidelobe_floor_db
        weights = column_weights(setup, effects, front_end)
        self._patterns = _pattern_table(setup.array, setup.radar.wavelength_m, weights.shape, weights.tobytes())
        self._limit = Limit(setup, effects, front_end, purpose, budget).each_beam
        self._skirt = np.minimum(SQUINTED * hann_skirt(setup.radar, REACH), 1.0).astype(np.float32)
        radar = setup.radar
        off = np.arange(-RANGE_BINS, RANGE_BINS + REACH + 1) - setup.radar.bandwidth_hz * setup.radar.chirp_period_s
        count = setup.radar.samples_per_chirp
        # least |2 N sin(pi off / N)| between a range bin and what the last chirp leaves, a band away.
        away = max(2.0 * count * float(np.abs(np.sin(np.pi * off / count)).min()), 1.0)
        #: Half the band over the carrier, delay over it for each metre, range bins for each metre and for each m/s,
        #: chirps for each metre, two samples, and `away`.
        self._rates = (
            0.5 * radar.bandwidth_hz / radar.carrier_hz,
            radar.chirp_slope_hz_per_s / SPEED_OF_LIGHT_MPS / radar.carrier_hz,
            radar.bandwidth_hz / SPEED_OF_LIGHT_MPS,
            radar.beam_duration_s / radar.range_bin_m + 2.0 * radar.chirp_period_s / radar.wavelength_m,
            1.0 / (SPEED_OF_LIGHT_MPS * radar.chirp_period_s),
            2.0 / count,
            away,
        )

    def selected(self, paths: Paths, beam: int) -> tuple[np.ndarray, np.ndarray]:
        """Return which paths a beam keeps, and which of them overlap, bool [P] each.

        Raises ValueError for paths that are not finite.
        """
        kept, overlaps = np.ones(len(paths), bool), np.full(len(paths), self._effects.chirp_overlap)
        if len(paths) < FEWEST:
            _require_finite(sum(float(np.abs(column).sum()) for column in _columns(paths)))
            return kept, overlaps
        strength, low, high, area, far, total = self._asked(paths, beam)
        _require_finite(total)
        near, everywhere, limit = np.zeros(RANGE_BINS), np.zeros(1), self._limit
        whole = kept, PATHS_SHARE * limit, self._skirt, far + self._skirt[-1]
        heads = overlaps, limit, np.zeros_like(self._skirt), far
        for stays, most, skirt, away in (whole, heads):
            # most are asked no further: alone they are too strong where they stand
            weak = np.flatnonzero(stays & (strength * (skirt[0] + area) <= most.max()))
            order = weak[np.argsort(strength[weak], kind="stable")]
            _leave(stays, order, strength, (low, high), most, skirt, area, away, near, everywhere)
            overlaps &= kept
        return kept, overlaps

    def bounds(self, paths: Paths, beam: int) -> np.ndarray:
        """Return a bound of each path's field in a beam at any instant of the sweep, sqrt(mW); float32 [P]."""
        return np.asarray(self._asked(paths, beam)[0])

    def _asked(self, paths: Paths, beam: int) -> _Asked:
        """Return what is asked of each path in a beam, and a sum that is finite where all of it is.

        The bound of its field; the first and the last range bin that its tone comes near; what the overlapped start of
        a unit echo changes nearby, and farther off.
        """
        amplitude, *angles, length_m, speed_mps = _columns(paths)
        steered, motion = self._setup.array.steered_ways, (length_m, speed_mps)
        asked: _Asked = _asked(
            self._patterns[:, :, beam], amplitude, tuple(angles), steered, motion, self._lobe, self._rates
        )
        return asked


def _columns(paths: Paths) -> tuple[np.ndarray, ...]:
    """Return what a beam asks of paths: amplitudes, angles of both ways, lengths and speeds."""
    angles = paths.azimuth_rad, paths.elevation_rad, paths.departure_azimuth_rad, paths.departure_elevation_rad
    return paths.amplitude, *angles, paths.length_m, paths.radial_speed_mps


def _require_finite(total: float) -> None:
    """Raise `ValueError` where a sum over all paths is not finite, as it is where each is."""
    if not math.isfinite(total):
        raise ValueError(f"paths of a beam must be finite, got {total!r}")


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


@compiled(error_model="numpy")
def _asked(patterns, amplitude, angles, steered, motion, lobe, rates):  # type: ignore[no-untyped-def]
    """Return `Weakest._asked` of paths from the largest patterns of a beam over the sine, [levels, steps].

    Doppler and motion within the beam move a tone. The start of a chirp is cut off its echo, and the last chirp's takes
    its place a band away: neither is more than the window there. Summed by parts, what is cut falls as 1 / off; nearby
    is what is cut off, and what takes its place from afar.
    """
    (length, speed), (peak, wide, high, floor_db) = motion, lobe
    band, late, tone_per_m, bins_per_mps, share_per_m, least_share, away = rates
    steps, count = patterns.shape[1], len(amplitude)
    scale = (steps - 1) / (2.0 * WIDEST_SINE)
    strength, area, far = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    low, up, total = np.empty(count, np.int64), np.empty(count, np.int64), 0.0
    for path in range(count):
        field, tone = abs(amplitude[path]), length[path] * tone_per_m
        total += field + length[path] + speed[path]
        for turn in range(2):
            azimuth, elevation = angles[2 * turn][path], angles[2 * turn + 1][path]
            total += azimuth + elevation
            # most leave where they arrive
            if turn == 0 or azimuth != angles[0][path] or elevation != angles[1][path]:
                level_db = max(-12.0 * ((azimuth / wide) ** 2 + (elevation / high) ** 2), floor_db)
                element = peak * 10.0 ** (0.05 * level_db) if abs(azimuth) <= 0.5 * np.pi else 0.0
                pattern = 0.0
            field *= element
            if turn >= steered or field == 0.0 or not np.isfinite(total):
                continue
            if pattern > 0.0:
                field *= pattern
                continue
            # the sweep scales what the array sees of a direction (`sweep_ratio`); what comes in is late by the delay
            sine = math.sin(azimuth) * math.cos(elevation)
            ends = sine * (1.0 - band - late * length[path]), sine * (1.0 + band)
            begin = max(int(np.floor((min(ends) + WIDEST_SINE) * scale)), 0)
            end = min(int(np.ceil((max(ends) + WIDEST_SINE) * scale)), steps - 1)
            level = 0
            while 2 ** (level + 1) <= end - begin + 1:
                level += 1
            pattern = max(patterns[level, begin], patterns[level, end - 2**level + 1])
            field *= pattern
        strength[path] = field
        more = abs(speed[path]) * bins_per_mps
        low[path] = int(min(max(np.rint(tone - more), 0.0), RANGE_BINS + REACH - 1.0))
        up[path] = int(min(max(np.rint(tone + more), 0.0), RANGE_BINS + REACH - 1.0))
        cut_rad = 2.0 * np.pi * min(length[path] * share_per_m + least_share, 1.0)
        cut, height = (cut_rad - math.sin(cut_rad)) / (2.0 * np.pi), 1.0 - math.cos(cut_rad)
        far[path] = min(cut, height / (2.0 * np.pi * REACH)) + min(cut, height / away)
        if tone > RANGE_BINS + REACH:
            far[path] = 2.0 * cut
        area[path] = cut + far[path]
    return strength, low, up, area, far, total


@compiled(fastmath=True)
def _leave(stays, order, strength, visited, limit, skirt, cut, away, near, everywhere):  # type: ignore[no-untyped-def]
    """Take the first of `order` that fit the limits [bins] out of `stays` [P], and add what they leave out to `near`
    [bins] and `everywhere` [1].
    """
    low, high = visited
    near_limit, far_limit = (1.0 - FAR_SHARE) * limit, FAR_SHARE * limit.min()
    for path in order:
        begin, end = max(low[path] - REACH, 0), min(high[path] + REACH + 1, len(limit))
        field = strength[path]
        fits = everywhere[0] + away[path] * field <= far_limit
        cell = begin
        while fits and cell < end:
            off = max(low[path] - cell, cell - high[path], 0)
            fits = near[cell] + (skirt[off] + cut[path]) * field <= near_limit[cell]
            cell += 1
        if not fits:
            continue
        stays[path] = False
        everywhere[0] += away[path] * field
        for cell in range(begin, end):
            near[cell] += (skirt[max(low[path] - cell, cell - high[path], 0)] + cut[path]) * field
