"""Scores over frames: sums by hand, empty sides, groups, intervals and paired differences."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lab.measures.frame_scores import (
    CAP_M,
    COUNTED,
    FrameAnswer,
    FrameScores,
    FrameTruth,
    bootstrap_weights,
    capped_chamfer,
    differences,
    estimates,
    measures,
    one_to_one_counts,
    score_frames,
)
from lab.measures.point_scores import Counts
from msgs.values.perception import PathClass

NOTHING = np.zeros((0, 2))


def truth(points: list[tuple[float, float, int]], places: list[tuple[float, float]], hidden: int = 0) -> FrameTruth:
    rows = np.array(points, float).reshape(-1, 3)
    places_m = np.array(places, float).reshape(-1, 2)
    return FrameTruth(
        points_m=rows[:, :2], path_class=rows[:, 2].astype(int), places_m=places_m, hidden_m=places_m[:hidden]
    )


def answer(
    points: list[tuple[float, float, int]], places: list[tuple[float, float]], hidden: int | None = None
) -> FrameAnswer:
    rows = np.array(points, float).reshape(-1, 3)
    places_m = np.array(places, float).reshape(-1, 2)
    return FrameAnswer(
        points_m=rows[:, :2], path_class=rows[:, 2].astype(int), recovered_m=places_m, hidden_m=places_m[:hidden]
    )


LOS, MIRRORED = int(PathClass.LOS), int(PathClass.MIRRORED)


def test_sums_of_two_frames_by_hand() -> None:
    """Frame 1: LOS 1 of 2 found, one mirrored claimed as LOS; frame 2: no answer at all, 3 misses stay counted.

    LOS: TP 1, FP 1, FN 2 -> F1 2/5. Mirrored: TP 0, FP 0, FN 2 -> 0. Macro 1/5. Recovered 1 m, released: the truth at
    (0, 5) has two places near: TP 1, FP 0 + 1 far, FN 1 (frame 2) -> F1 2/4; one to one: FP 2 -> 2/5.
    """
    scores = score_frames(
        [
            (
                answer([(10, 0, LOS), (20, 0, LOS)], [(0, 5.2), (0, 4.8), (30, 0)]),
                truth([(10.5, 0, LOS), (15, 0, LOS), (20, 0, MIRRORED)], [(0, 5)]),
            ),
            (answer([], []), truth([(8, 0, LOS), (9, 9, MIRRORED)], [(1, 1)])),
        ]
    )
    found = {name: float(value[0]) for name, value in measures(scores).items()}
    assert found["dense_los_f1"] == pytest.approx(0.4)
    assert found["dense_mirrored_f1"] == 0.0
    assert found["dense_macro_f1"] == pytest.approx(0.2)
    assert found["recovered_1m_f1"] == pytest.approx(0.5)
    assert found["recovered_1m_one_to_one_f1"] == pytest.approx(0.4)
    assert found["recovered_1m_precision"] == pytest.approx(0.5)
    assert found["recovered_1m_recall"] == pytest.approx(0.5)


def test_frame_with_nothing_hidden_counts_its_false_alarms() -> None:
    scores = score_frames([(answer([], [(1, 1), (2, 2)]), truth([], [])), (answer([], [(5, 5)]), truth([], [(5, 5)]))])
    assert scores.counts[0, COUNTED.index("recovered_1m")].tolist() == [0, 2, 0]
    assert measures(scores)["recovered_1m_precision"][0] == pytest.approx(1 / 3)


def test_hidden_scores_ask_for_hidden_objects_alone() -> None:
    """Two places recovered exactly, one of a hidden object: the other is right for one score, false for the other."""
    scores = score_frames([(answer([], [(0, 5), (9, 9)]), truth([], [(0, 5), (9, 9)], hidden=1))])
    found = measures(scores)
    assert found["recovered_1m_f1"][0] == 1.0
    assert found["hidden_1m_f1"][0] == pytest.approx(2 / 3)
    # who rejects the other is right in both
    rejecting = score_frames([(answer([], [(0, 5), (9, 9)], hidden=1), truth([], [(0, 5), (9, 9)], hidden=1))])
    assert measures(rejecting)["recovered_1m_f1"][0] == measures(rejecting)["hidden_1m_f1"][0] == 1.0


def test_chamfer_with_empty_sides() -> None:
    """Four frames: both sides (3 m apart: 6 m, 18 m^2), one side empty twice, both empty.

    The released mean is over the first alone, infinite share 1/2, nothing share 1/4; the capped mean is over all:
    (6 + 2 cap + 2 cap + 0) / 4.
    """
    pairs = [
        (answer([], [(0, 0)]), truth([], [(3, 0)])),
        (answer([], [(0, 0)]), truth([], [])),
        (answer([], []), truth([], [(3, 0)])),
        (answer([], []), truth([], [])),
    ]
    found = {name: float(value[0]) for name, value in measures(score_frames(pairs)).items()}
    assert found["recovered_chamfer_m"] == pytest.approx(6.0)
    assert found["recovered_chamfer_m2"] == pytest.approx(18.0)
    assert found["recovered_infinite_share"] == 0.5
    assert found["recovered_nothing_share"] == 0.25
    assert found["recovered_chamfer_capped_m"] == pytest.approx((6.0 + 4.0 * CAP_M) / 4.0)
    assert found["recovered_chamfer_capped_m2"] == pytest.approx((18.0 + 4.0 * CAP_M**2) / 4.0)


def test_capped_chamfer_is_never_more_than_that_of_no_answer() -> None:
    far = capped_chamfer(np.array([[500.0, 0.0]]), np.zeros((1, 2)))
    assert far == capped_chamfer(NOTHING, np.zeros((1, 2)))
    assert far.metres == 2.0 * CAP_M


def test_one_to_one_finds_each_truth_once() -> None:
    predicted = np.array([[0.0, 0.0], [0.1, 0.0], [5.0, 0.0]])
    assert one_to_one_counts(predicted, np.zeros((1, 2)), 1.0) == Counts(1, 2, 0)


def random_scores(frames: int, hit: float, seed: int) -> FrameScores:
    rng = np.random.default_rng(seed)
    counts = np.zeros((frames, len(COUNTED), 3), int)
    found = rng.binomial(10, hit, (frames, len(COUNTED)))
    counts[..., 0], counts[..., 2] = found, 10 - found
    return FrameScores(counts, np.ones((frames, 4, 4)))


@pytest.mark.slow
def test_intervals_cover_the_truth_and_pairs_are_tighter() -> None:
    """Recall of 10 binomial trials a frame, 60 frames: the percentile interval's half width is near
    1.96 sqrt(p q / 600) = 0.032 (tolerance a third), and it covers p in at least 85 of 100 repetitions.

    Two methods with a common luck differ by much less than their own intervals: the paired interval excludes 0.
    """
    weights = bootstrap_weights(60, 300, 1)
    inside = 0
    for seed in range(100):
        got = estimates(random_scores(60, 0.8, seed), weights)["recovered_1m_recall"]
        inside += got.low <= 0.8 <= got.high
    assert inside >= 85
    assert (got.high - got.low) / 2.0 == pytest.approx(1.96 * math.sqrt(0.16 / 600), rel=1 / 3)
    one = random_scores(60, 0.8, 5)
    worse = FrameScores(np.maximum(one.counts - [1, 0, -1], 0), one.distances)
    paired = differences(one, worse, weights)["recovered_1m_recall"]
    assert paired.value == pytest.approx(0.1, abs=1e-9)
    assert paired.high - paired.low < 0.01


def test_same_seed_same_draws() -> None:
    assert np.array_equal(bootstrap_weights(7, 20, 3), bootstrap_weights(7, 20, 3))
    assert not np.array_equal(bootstrap_weights(7, 20, 3), bootstrap_weights(7, 20, 4))
    assert (bootstrap_weights(7, 20, 3).sum(axis=1) == 7).all()
    with pytest.raises(ValueError, match="frames and draws must be at least 1, got 0"):
        bootstrap_weights(0, 20, 3)
