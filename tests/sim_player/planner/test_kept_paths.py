"""What goes of a scene at rest: its limit on beams and map, guesses made again, overlap added up by hand."""

from __future__ import annotations

import numpy as np
import pytest

from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.places import random_place
from sim_player.paths.conversion import as_paths
from sim_player.paths.ray_tracing import trace_echoes
from sim_player.paths.reach import reachable_snapshot
from sim_player.planner import kept_paths
from sim_player.planner.ablation import signal_effects
from sim_player.planner.cells import cells_of
from sim_player.planner.kept_paths import Limit, choose
from sim_player.planner.purposes import Purpose
from sim_player.planner.sweep_terms import SweepTerms, sweep_terms
from sim_player.scene.front_end import NO_FAULTS
from sim_player.scene.world import prepare
from sim_player.signal.levels import noise_rms

FLAGS = signal_effects(ALL_EFFECTS)
PLACE = random_place(21, 0)
SETUP = PLACE.setup
LIMIT = Limit(SETUP, FLAGS, NO_FAULTS, Purpose.OBJECTS, 0.1)


@pytest.fixture(scope="module")
def terms() -> SweepTerms:
    view = reachable_snapshot(prepare(PLACE))
    paths = as_paths(view, trace_echoes(view, ALL_EFFECTS), ALL_EFFECTS)
    return sweep_terms(SETUP, paths, FLAGS, NO_FAULTS, 1e-3 * float(LIMIT.each_beam.min()))


@pytest.mark.parametrize("beams", [1, 5, 25])
def test_no_cell_changes_by_more_than_is_said(beams: int) -> None:
    """Random changes of so many beams, and an error as bad as signs allow: the worst cell of beams and map against the
    law's least reference. Changes that are the map's own direction come to what is said.
    """
    rng, cells = np.random.default_rng(beams), cells_of(SETUP)
    rms = noise_rms(SETUP, FLAGS, NO_FAULTS)
    floor = cells.floor(np.zeros((25, 512)), rms, purpose=Purpose.OBJECTS)
    changed = np.zeros((25, 512), np.complex64)
    changed[:beams] = 1e-3 * rms * (rng.standard_normal((beams, 512)) + 1j * rng.standard_normal((beams, 512)))
    bound = 1e-3 * rms * rng.random(512)
    worst = (np.abs(cells.values(changed)) + cells.bounds(np.broadcast_to(bound, (25, 512)))) / floor
    assert worst.max() <= 0.1 * LIMIT.spent(changed, bound)
    aligned = np.conj(cells._matrix[:, 128:129]) * np.ones(512)
    assert np.abs(cells.values(aligned) / floor).max() * kept_paths.INFLATION == pytest.approx(
        0.1 * LIMIT.spent(aligned, 0.0), rel=1e-3
    )


def test_a_guess_that_changes_too_much_is_made_again(terms: SweepTerms, monkeypatch: pytest.MonkeyPatch) -> None:
    """A guess of twenty times too much leaves less out than the first good one; one that never comes to the law, and
    one beyond all guesses, leave everything.
    """
    good = choose(SETUP, terms, FLAGS, LIMIT)
    assert 0 < good.kept.sum() < len(terms)
    assert good.squints.sum() < good.kept.sum()
    monkeypatch.setattr(kept_paths, "PEAK", kept_paths.PEAK / 20.0)
    monkeypatch.setattr(kept_paths, "GUESSES", 30)
    again = choose(SETUP, terms, FLAGS, LIMIT)
    assert again.spent <= kept_paths.PHASE_SHARE + kept_paths.OVERLAP_SHARE + 1e-6
    assert again.kept.sum() < len(terms)
    monkeypatch.setattr(kept_paths, "GUESSES", 1)
    nothing = choose(SETUP, terms, FLAGS, LIMIT)
    assert np.stack([nothing.kept, nothing.squints, nothing.overlaps]).all()
    assert nothing.spent == 0.0


def test_overlap_goes_while_its_sum_is_small() -> None:
    """Four paths in one beam, a tenth of each cut off: one that goes anyhow, one without squint, whose start changes by
    that; then the weakest while the sum stays under 0.5: 0.1 + 0.05 + 0.2, and 0.4 is too much.
    """
    kept, squints = np.array([False, True, True, True]), np.array([False, False, True, True])
    whole = np.array([[1.0], [9.0], [2.0], [4.0]], np.float32)
    squint = np.array([[0.3], [0.5], [1.0], [1.0]], np.float32)
    stays, spent = kept_paths._overlaps(kept, squints, np.full(4, 0.1), (whole, squint), 0.5)
    assert stays.tolist() == [False, True, False, True]
    assert spent == pytest.approx(0.35)
