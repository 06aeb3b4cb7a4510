"""The literal level, reference of all others: chirps in time, delayed and mixed, pattern at every sample, float64.

For few paths, beams and chirps: every path costs its samples times the columns of the array.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from models.physics.antenna import element_field, row_field
from msgs.values.radar import RadarParams, RadarSetup
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.scene.front_end import NO_FAULTS, FrontEnd
from sim_player.signal.levels import hann_profiles
from sim_player.signal.switches import PLAIN, SignalEffects, column_weights, isotropic, sampled, sweep_ratio
from sim_player.trace.path_table import Paths


def literal_echoes(
    setup: RadarSetup,
    paths: Paths,
    effects: SignalEffects = PLAIN,
    front_end: FrontEnd = NO_FAULTS,
    beam: int = 0,
    chirps: Sequence[int] = (0,),
) -> np.ndarray:
    """Return the reference: chirps of Eq. (6) back to back, delayed, mixed; complex128 [chirps, samples], in sqrt(mW).

    Delays change by samples with range migration, by chirps in phase alone without. Low pass: `sampled`.
    """
    setup_seen = setup if effects.element_pattern else isotropic(setup)
    columns = column_weights(setup, effects, front_end)[beam]
    samples = np.zeros((len(chirps), setup.radar.samples_per_chirp), np.complex128)
    for index in np.flatnonzero(paths.amplitude):
        _add_literal_echo(samples, setup_seen, columns, paths.take(np.array([index])), effects, chirps)
    return samples


def literal_profiles(
    setup: RadarSetup,
    paths: Paths,
    effects: SignalEffects = PLAIN,
    front_end: FrontEnd = NO_FAULTS,
    beams: Sequence[int] = (0,),
) -> np.ndarray:
    """Return the Hann-windowed range profiles of one chirp of each of some beams, sqrt(mW); complex128 [beams, 512]."""
    samples = [literal_echoes(setup, paths, effects, front_end, int(beam)) for beam in beams]
    return hann_profiles(np.concatenate(samples), setup.radar.samples_per_chirp)


def chirp_turns(radar: RadarParams, time_s: np.ndarray) -> np.ndarray:
    """Return the phase of Eq. (6) in turns, f_c t + S t^2 / 2; reduce it to a fraction before it becomes an angle."""
    return radar.carrier_hz * time_s + 0.5 * radar.chirp_slope_hz_per_s * time_s**2


def _add_literal_echo(
    samples: np.ndarray,
    setup: RadarSetup,
    columns: np.ndarray,
    path: Paths,
    effects: SignalEffects,
    chirps: Sequence[int],
) -> None:
    """Add one path to its chirps, [chirps, samples]; nothing that comes from behind, and no pattern twice."""
    arrival = path.azimuth_rad, path.elevation_rad
    departure = path.departure_azimuth_rad, path.departure_elevation_rad
    if not all(element_field(setup.element, *direction).any() for direction in (arrival, departure)):
        return
    radar = setup.radar
    time_s = np.arange(radar.samples_per_chirp) / radar.sample_rate_hz
    sent_turns = chirp_turns(radar, time_s)
    closing = 2.0 * path.radial_speed_mps[0] / SPEED_OF_LIGHT_MPS if effects.motion else 0.0
    pattern: np.ndarray | None = None
    for row, chirp in zip(samples, chirps, strict=True):
        since_middle_s = (chirp - 0.5 * (radar.chirps_per_beam - 1)) * radar.chirp_period_s
        moved_s = closing * (since_middle_s + time_s) if effects.range_migration else 0.0
        since_sent_s = time_s - (path.length_m[0] / SPEED_OF_LIGHT_MPS + moved_s)
        previous = (since_sent_s < 0.0) & effects.chirp_overlap
        since_sent_s = np.where(previous, since_sent_s + radar.chirp_period_s, since_sent_s)
        turns = sent_turns - chirp_turns(radar, since_sent_s)
        if not effects.range_migration:
            turns = turns + radar.carrier_hz * closing * since_middle_s
        passes = ~previous | sampled(radar, radar.chirp_slope_hz_per_s * (time_s - since_sent_s))
        # of a path whose delay stays the same every chirp sees the same pattern
        if pattern is None or (effects.squint and effects.range_migration and closing):
            ratio = sweep_ratio(radar, since_sent_s) if effects.squint else np.ones(1)
            received = _literal_pattern(setup, columns, *arrival, ratio)
            if setup.array.steered_ways == 1:
                sent = element_field(setup.element, *departure)
            else:
                sent = received if arrival == departure else _literal_pattern(setup, columns, *departure, ratio)
            pattern = np.conj(path.amplitude[0] * sent * received)
        row += passes * pattern * np.exp(2j * np.pi * (turns % 1.0))


def _literal_pattern(
    setup: RadarSetup, columns: np.ndarray, azimuth_rad: np.ndarray, elevation_rad: np.ndarray, ratio: np.ndarray
) -> np.ndarray:
    """Return the one-way field of one direction, element by element, at samples' frequency ratios; [samples] or [1]."""
    array, wavelength_m = setup.array, setup.radar.wavelength_m
    across = 2.0 * np.pi / wavelength_m * array.column_spacing(wavelength_m) * ratio
    step_rad = across * np.sin(azimuth_rad) * np.cos(elevation_rad)
    # the columns one after the other, each a step on from the last; the middle of the array has no phase
    step, turn = np.exp(1j * step_rad), np.exp(-0.5j * (array.columns - 1) * step_rad)
    field = np.zeros(len(ratio), np.complex128)
    for weight in columns:
        field += weight * turn
        turn = turn * step
    field = field / np.sqrt(array.columns) * row_field(array, wavelength_m, elevation_rad, ratio)
    return field * element_field(setup.element, azimuth_rad, elevation_rad)
