"""Bounds against the signals they bound: every cell, every kind of path, and tight where one path stands alone."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from msgs.values.radar import RadarSetup
from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.places import random_place
from sim_player.planner.bounds import Envelope, _overlap_kernel, swept_pattern
from sim_player.scene.front_end import NO_FAULTS
from sim_player.scene.world import prepare
from sim_player.signal.levels import kernel_profiles
from sim_player.signal.switches import IDEAL, PLAIN
from sim_player.trace.paths import Paths
from sim_player.trace.ray_tracing import trace
from tests.sim_player.signal.references import ALL

SETUP = RadarSetup()
STATIC = msgspec.structs.replace(
    ALL, motion=False, range_migration=False, iq_imbalance=False, leakage=False, spurs=False
)
NO_OVERLAP = msgspec.structs.replace(STATIC, chirp_overlap=False)


def place_paths(index: int) -> Paths:
    scene = random_place(11, index)
    return trace(prepare(scene, index), 0.0, ALL_EFFECTS)


@pytest.mark.slow
@pytest.mark.parametrize("index", [0, 1, 2])
def test_no_signal_exceeds_its_bound(index: int) -> None:
    """Single paths and all of a place: squint on, then overlap, then the change that squint makes; no cell above 1."""
    paths = place_paths(index)
    envelope = Envelope(SETUP, 512, float(paths.length_m.max()))
    manual_plan = np.random.default_rng(index).integers(0, len(paths), 8)
    for which in [*manual_plan[:, None], np.arange(len(paths))]:
        some = paths.take(which)
        pattern, step = swept_pattern(SETUP, some, STATIC, NO_FAULTS), envelope.step(some)
        strength = np.abs(some.amplitude)
        swept = kernel_profiles(SETUP, some, NO_OVERLAP)
        assert (np.abs(swept) <= envelope.of_terms(pattern.magnitudes() * strength, step)).all()
        overlapped = np.abs(kernel_profiles(SETUP, some, STATIC) - swept)
        magnitude = (pattern.magnitudes() * strength).sum(axis=0)
        # what the sum of both rounds: 1e-12 of the strongest
        assert (overlapped <= envelope.of_overlap(magnitude, step) + 1e-12 * magnitude.sum()).all()
        change = np.abs(swept - kernel_profiles(SETUP, some, PLAIN))
        assert (change <= envelope.of_terms(pattern.squint() * strength, step)).all()


def test_one_path_is_bounded_tightly_where_it_stands() -> None:
    """At a path's own cell the bound is off by what a Hann window falls within a quarter of a bin: 1 dB at most."""
    paths = place_paths(0).take(np.array([0]))
    envelope = Envelope(SETUP, 512, 50.0)
    pattern = swept_pattern(SETUP, paths, IDEAL, NO_FAULTS)
    bound = envelope.of_terms(pattern.magnitudes() * np.abs(paths.amplitude), envelope.step(paths))
    signal = np.abs(kernel_profiles(SETUP, paths, IDEAL))
    beam, cell = np.unravel_index(np.argmax(signal), signal.shape)
    assert 0.0 <= 20.0 * np.log10(bound[beam, cell] / signal[beam, cell]) <= 1.2


def test_nothing_bounds_to_nothing() -> None:
    paths = place_paths(0).take(np.zeros(0, int))
    envelope = Envelope(SETUP, 512, 1.0)
    pattern = swept_pattern(SETUP, paths, STATIC, NO_FAULTS)
    assert not envelope.of_terms(pattern.magnitudes(), envelope.step(paths)).any()


def test_no_bound_is_negative_beyond_the_spectrum() -> None:
    """Tones farther than a spectrum repeats: nothing is known of where they fall, so they bound to all they may be."""
    radar = SETUP.radar
    kernel = _overlap_kernel(radar, 512, 3 * radar.samples_per_chirp)
    assert np.isfinite(kernel).all()
    assert (kernel >= 0.0).all()
    near = _overlap_kernel(radar, 512, 512)
    np.testing.assert_array_equal(kernel[: len(near)], near)
