"""Evaluated profiles against the kernel level, and their error bounds."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from msgs.values.radar import RadarSetup
from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.places import random_place
from sim_player.paths.ray_tracing import trace
from sim_player.planner.evaluation import NOTHING, SQUINT, WHOLE, HeadChange, error, evaluate
from sim_player.planner.sweep_terms import SweepTerms, sweep_terms
from sim_player.scene.front_end import NO_FAULTS
from sim_player.scene.world import prepare
from sim_player.signal.levels import kernel_profiles, noise_rms
from sim_player.trace.path_table import Paths
from tests.sim_player.signal.references import ALL

SETUP = RadarSetup()
BINS = 512
STATIC = msgspec.structs.replace(
    ALL, motion=False, range_migration=False, iq_imbalance=False, leakage=False, spurs=False
)
NO_OVERLAP = msgspec.structs.replace(STATIC, chirp_overlap=False)
NO_SWEEP = msgspec.structs.replace(NO_OVERLAP, squint=False)
RMS = noise_rms(SETUP, STATIC, NO_FAULTS)


def place(index: int) -> tuple[Paths, SweepTerms]:
    """All paths of a place, to a thousandth of the noise."""
    scene = random_place(11, index)
    paths = trace(prepare(scene, index), 0.0, ALL_EFFECTS)
    return paths, sweep_terms(SETUP, paths, STATIC, NO_FAULTS, 1e-3 * float(RMS.min()))


@pytest.mark.slow
@pytest.mark.parametrize("index", [0, 1, 2])
def test_evaluation_stays_within_its_error(index: int) -> None:
    """All echoes of a place, and their squint alone, against float64: errors within the bound, bound under noise."""
    paths, terms = place(index)
    swept, steady = kernel_profiles(SETUP, paths, NO_OVERLAP), kernel_profiles(SETUP, paths, NO_SWEEP)
    for part, reference in ((WHOLE, swept), (SQUINT, swept - steady)):
        parts = np.full(len(paths), part)
        bound = error(SETUP.radar, terms, parts, BINS)
        assert (np.abs(evaluate(SETUP.radar, terms, parts, BINS) - reference) <= bound).all()
        assert (bound < RMS).all()
    assert not evaluate(SETUP.radar, terms, np.full(len(paths), NOTHING), BINS).any()


@pytest.mark.slow
@pytest.mark.parametrize("index", [0, 1, 2])
def test_overlap_in_closed_form_stays_within_its_error(index: int) -> None:
    """The overlapped start of all echoes, of a random half, and of eight lone ones, against the kernel level."""
    paths, terms = place(index)
    change_of = HeadChange(SETUP.radar, terms, BINS, 1e-2 * float(RMS.min()))
    rng = np.random.default_rng(index)
    every = np.ones(len(paths), bool)
    lone = [np.arange(len(paths)) == one for one in rng.integers(0, len(paths), 8)]
    for mask in (every, rng.random(len(paths)) < 0.5, *lone):
        some = paths.take(mask)
        reference = kernel_profiles(SETUP, some, STATIC) - kernel_profiles(SETUP, some, NO_OVERLAP)
        change, bound = change_of(mask)
        # the reference rounds at 1e-12 of the strongest
        assert (np.abs(change - reference) <= bound + 1e-10 * np.abs(some.amplitude).sum()).all()
        assert (bound < RMS).all()


@pytest.mark.parametrize("off_bins", [0.0, 1e-9, 3e-4, 8e-4, 9.99e-4, 1.01e-3, 1e-2, 0.5])
@pytest.mark.parametrize("near", [16, 120, 400])
def test_overlap_beside_the_poles_of_its_closed_form(off_bins: float, near: int) -> None:
    """The strongest echo of a place, moved beside a bin that is evaluated: within the bound, which is small.

    The closed form divides by the distance from the tone to a bin twice. With an angle known to first order only, the
    change was a tenth off within a thousandth of a bin.
    """
    paths, _ = place(0)
    lone = paths.take(np.array([int(np.argmax(np.abs(paths.amplitude)))]))
    length_m = np.array([2.0 * (near + 1.0 + off_bins) * SETUP.radar.range_bin_m])
    lone = replace(lone, length_m=length_m)
    terms = sweep_terms(SETUP, lone, STATIC, NO_FAULTS, 0.0)
    reference = kernel_profiles(SETUP, lone, STATIC) - kernel_profiles(SETUP, lone, NO_OVERLAP)
    change, bound = HeadChange(SETUP.radar, terms, BINS, 0.0)(np.ones(1, bool))
    assert (np.abs(change - reference) <= bound + 1e-10 * np.abs(lone.amplitude)).all()
    assert bound.max() < 1e-2 * np.abs(reference).max()


def test_one_echo_stands_where_it_belongs() -> None:
    """An echo at bin 100 of the middle beam: its profile is the kernel level's to 1e-5 of its peak."""
    paths, _ = place(0)
    lone = paths.take(np.array([int(np.argmax(np.abs(paths.amplitude)))]))
    terms = sweep_terms(SETUP, lone, STATIC, NO_FAULTS, 0.0)
    reference = kernel_profiles(SETUP, lone, NO_OVERLAP)
    found = evaluate(SETUP.radar, terms, np.array([WHOLE]), BINS)
    assert np.abs(found - reference).max() < 1e-5 * np.abs(reference).max()
