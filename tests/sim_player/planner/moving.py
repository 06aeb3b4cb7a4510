"""Echoes of a moving scene in range and Doppler bins, and what the law of a plan holds them against."""

from __future__ import annotations

import numpy as np

from models.perception.form.slow_time_sums import group_edges
from sim_player.planner.cells import cells_of
from sim_player.planner.plan import Plan
from sim_player.signal.levels import RANGE_BINS, echo_terms, noise_rms
from sim_player.signal.slow_time_profiles import group_profiles
from sim_player.trace.path_table import Paths


def reference(plan: Plan) -> np.ndarray:
    """Least reference of the law in any cell, whatever stands there, [beams + azimuths, bins]."""
    front_end = plan.view.world.scene.radar.front_end
    nothing = np.zeros((len(plan.setup.beams), RANGE_BINS), np.complex64)
    return cells_of(plan.setup).floor(nothing, noise_rms(plan.setup, plan.signal, front_end), purpose=plan.purpose)


def doppler_bins(
    plan: Plan, paths: Paths, beam: int, precision: str = "float32", overlaps: np.ndarray | None = None
) -> np.ndarray:
    """Echoes of paths in the Doppler and range bins of a beam, complex [8, bins]."""
    front_end = plan.view.world.scene.radar.front_end
    edges = group_edges(plan.setup.radar.chirps_per_beam, 8)
    terms = echo_terms(plan.setup, paths, plan.signal, front_end, beam, precision, overlaps)
    return np.fft.fft(group_profiles(plan.setup, terms, edges, plan.signal, front_end), axis=0)


def left_out(plan: Plan, paths: Paths, beam: int, chosen_at: Paths | None = None) -> np.ndarray:
    """What a beam's choice changes of its echoes, in the same bins; `chosen_at`: the paths at which it chooses."""
    assert plan.weakest is not None
    kept, overlaps = plan.weakest.selected(paths if chosen_at is None else chosen_at, beam)
    return doppler_bins(plan, paths, beam) - doppler_bins(plan, paths.take(kept), beam, overlaps=overlaps[kept])
