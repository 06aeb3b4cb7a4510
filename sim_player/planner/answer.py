"""The map of the paths that a plan keeps, at the kernel level: evaluated in single precision, its error bounded.

What its terms along the sweep leave out and what is rounded is bounded before anything is asked of the map, and over
what stands in its cells where that alone is not enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msgs.values.radar import RadarSetup
from sim_player.planner.ablation import SIGMAS, mirrored
from sim_player.planner.cells import cells_of
from sim_player.planner.evaluation import NOTHING, STEADY, WHOLE, HeadChange, error, evaluate
from sim_player.planner.kept_paths import INFLATION, Choice
from sim_player.planner.purposes import Purpose
from sim_player.planner.sweep_terms import SweepTerms
from sim_player.scene.front_end import FrontEnd
from sim_player.signal.levels import RANGE_BINS, noise_rms
from sim_player.signal.receiver import iq_factors
from sim_player.signal.switches import SignalEffects

#: What the overlap of the weakest may leave out, of what errors may take.
HEADS_SHARE = 0.15


@dataclass(frozen=True)
class Answer:
    """Profiles of the kept paths, I and Q unbalanced, complex64 [B, bins]; the share of the budget that errors take.

    Without leakage and spurs.
    """

    profiles: np.ndarray
    spent: float


@dataclass(frozen=True)
class Law:
    """What may change: the purpose, the budget (a field ratio), and the most in each range bin of any beam, [bins];
    the share of that which is left for errors.
    """

    purpose: Purpose
    budget: float
    limit: np.ndarray
    left: float


def evaluated(
    setup: RadarSetup, terms: SweepTerms, choice: Choice, effects: SignalEffects, front_end: FrontEnd, law: Law
) -> Answer | None:
    """Return the profiles of the paths that a choice keeps; None where their errors do not fit the budget."""
    radar, overlaps = setup.radar, choice.overlaps
    part = np.where(choice.kept, np.where(choice.squints, WHOLE, STEADY), NOTHING)
    bound = error(radar, terms, part, RANGE_BINS)
    values = evaluate(radar, terms, part, RANGE_BINS)
    if overlaps.any():
        spare = HEADS_SHARE * law.left * float(law.limit.min())
        heads, loose = HeadChange(radar, terms.take(overlaps), RANGE_BINS, spare)(np.ones(int(overlaps.sum()), bool))
        values, bound = values + heads, bound + loose
    wanted, image = iq_factors(front_end)
    if image != 0.0:
        bound = (bound + abs(image) * mirrored(np.abs(values) + bound)).max(axis=0)
    spent = float((bound / law.limit).max())
    if spent > law.left:
        faulty = image != 0.0 or front_end.leakage_dbm is not None or bool(front_end.spurs) or effects.rain_clutter
        spent = INFLATION * _over_what_stands(setup, values, bound, noise_rms(setup, effects, front_end), law)
        # faults may take off what stands in a cell
        if faulty or spent > law.left:
            return None
    factor = np.complex64(wanted if setup.beat_sign > 0 else np.conj(wanted))
    return Answer(values * factor, spent)


def _over_what_stands(setup: RadarSetup, values: np.ndarray, bound: np.ndarray, rms: np.ndarray, law: Law) -> float:
    """Return the largest error over what the law allows where it counts what surely stands in a cell."""
    # of everything, what was left out may be missing here
    unknown, cells = bound + law.limit, cells_of(setup)
    # most bins are far under it anyhow; for samples bins count for their neighbours
    asked = bound / law.limit > (law.left if law.purpose is not Purpose.SAMPLES else 0.0)
    everywhere, missing = (
        np.broadcast_to(part[asked].astype(np.float32), (len(values), int(asked.sum()))) for part in (bound, unknown)
    )
    floor = cells.floor(values[:, asked], rms[asked], missing, SIGMAS, law.purpose)
    rest = float((bound / law.limit)[~asked].max(initial=0.0))
    return max(float((cells.bounds(everywhere) / floor).max()) / law.budget, rest)
