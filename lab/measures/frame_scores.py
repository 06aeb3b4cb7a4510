"""Quality of one method over many frames: counts of each frame, sums over frames, and their uncertainty.

Every frame is reduced to a row of numbers once; all tables, groups and bootstrap draws are weighted sums of rows. No
frame is skipped: one without an answer counts its misses, one without hidden points its false alarms.

The Chamfer distance of a frame with one side empty has no value in the released definition. Its mean is therefore given
over the frames where both sides hold points, beside the shares of the others, and once more over all frames with every
distance capped at `CAP_M`: there, a frame with one side empty is charged the maximum, a cap in each direction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lab.measures.point_scores import Chamfer, Counts, chamfer, dense_counts, match_points, recovered_counts
from msgs.values.perception import PathClass

#: Gate of the dense matching and the two of the recovered one (simulated, real captures).
DENSE_GATE_M = 2.0
RECOVERED_GATES_M = (1.0, 2.0)
#: Maximum of each distance of the capped Chamfer.
CAP_M = 20.0
#: Triples (true positives, false positives, false negatives) of a row, in order.
COUNTED = (
    "los",
    "mirrored",
    "recovered_1m",
    "recovered_2m",
    "recovered_1m_one_to_one",
    "recovered_2m_one_to_one",
    "hidden_1m",
    "hidden_2m",
)
#: Distances of a row, in order, each (released m, released m^2, capped m, capped m^2).
MEASURED = ("los", "mirrored", "recovered", "hidden")
#: Percentiles of an interval.
INTERVAL = (2.5, 97.5)


@dataclass(frozen=True, kw_only=True)
class FrameTruth:
    """Truth of one frame in metres."""

    #: Apparent positions of returns [N, 2], and the `PathClass` of each [N].
    points_m: np.ndarray
    path_class: np.ndarray
    #: True positions of all images [M, 2], whatever the number of mirrors: for the recovered scores.
    places_m: np.ndarray
    #: Those of objects that only mirrors show [H, 2]: for the hidden scores.
    hidden_m: np.ndarray


@dataclass(frozen=True, kw_only=True)
class FrameAnswer:
    """Answer of a method for one frame, in metres."""

    #: Peaks [N, 2], and the `PathClass` of each [N].
    points_m: np.ndarray
    path_class: np.ndarray
    #: Positions of all images folded back [M, 2]; and those it holds for hidden, all if it rejects none [H, 2].
    recovered_m: np.ndarray
    hidden_m: np.ndarray


@dataclass(frozen=True)
class FrameScores:
    """Rows of F frames: counts int64 [F, 8, 3] as `COUNTED`, distances [F, 4, 4] as `MEASURED`.

    Infinite released distances mean that one side is empty, NaN that both are.
    """

    counts: np.ndarray
    distances: np.ndarray

    def __len__(self) -> int:
        return len(self.counts)


def score_frames(pairs: Iterable[tuple[FrameAnswer, FrameTruth]]) -> FrameScores:
    """Return rows of all frames, in order."""
    rows = [(_counts(answer, truth), _distances(answer, truth)) for answer, truth in pairs]
    counts = np.array([row[0] for row in rows], np.int64).reshape(-1, len(COUNTED), 3)
    distances = np.array([row[1] for row in rows], np.float64).reshape(-1, len(MEASURED), 4)
    return FrameScores(counts, distances)


def _counts(answer: FrameAnswer, truth: FrameTruth) -> list[tuple[int, int, int]]:
    """Return the triples of one frame."""
    dense = dense_counts(answer.points_m, answer.path_class, truth.points_m, truth.path_class, DENSE_GATE_M)
    counted = [dense[path_class] for path_class in PathClass]
    counted += [recovered_counts(answer.recovered_m, truth.places_m, gate_m) for gate_m in RECOVERED_GATES_M]
    counted += [one_to_one_counts(answer.recovered_m, truth.places_m, gate_m) for gate_m in RECOVERED_GATES_M]
    counted += [recovered_counts(answer.hidden_m, truth.hidden_m, gate_m) for gate_m in RECOVERED_GATES_M]
    return [(counts.true_positives, counts.false_positives, counts.false_negatives) for counts in counted]


def one_to_one_counts(predicted_m: np.ndarray, truth_m: np.ndarray, gate_m: float) -> Counts:
    """Return the counts of one frame if a truth point may be found once and a prediction may find one."""
    matched = len(match_points(predicted_m, truth_m, gate_m))
    return Counts(matched, len(predicted_m) - matched, len(truth_m) - matched)


def _distances(answer: FrameAnswer, truth: FrameTruth) -> list[tuple[float, float, float, float]]:
    """Return the quadruples of one frame."""
    sides = [(answer.points_m[answer.path_class == k], truth.points_m[truth.path_class == k]) for k in PathClass]
    sides += [(answer.recovered_m, truth.places_m), (answer.hidden_m, truth.hidden_m)]
    rows = []
    for predicted_m, truth_m in sides:
        released, capped = chamfer(predicted_m, truth_m), capped_chamfer(predicted_m, truth_m)
        empty = len(predicted_m) + len(truth_m) == 0
        both = (np.nan, np.nan) if empty else (released.metres, released.square_metres)
        rows.append((*both, capped.metres, capped.square_metres))
    return rows


def capped_chamfer(predicted_m: np.ndarray, truth_m: np.ndarray, cap_m: float = CAP_M) -> Chamfer:
    """Return the Chamfer distance with every nearest distance capped at `cap_m`.

    Zero if both sides are empty; 2 cap_m and 2 cap_m^2, the maximum, if one is.
    """
    if len(predicted_m) == 0 and len(truth_m) == 0:
        return Chamfer(0.0, 0.0)
    if len(predicted_m) == 0 or len(truth_m) == 0:
        return Chamfer(2.0 * cap_m, 2.0 * cap_m**2)
    to_truth = np.minimum(cKDTree(truth_m).query(predicted_m)[0], cap_m)
    to_predicted = np.minimum(cKDTree(predicted_m).query(truth_m)[0], cap_m)
    return Chamfer(float(to_truth.mean() + to_predicted.mean()), float(np.mean(to_truth**2) + np.mean(to_predicted**2)))


def measures(scores: FrameScores, weights: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Return all measures by name under weights [B, F] of the frames (default: each once), arrays [B].

    F1s are of counts summed over frames (micro), distances means over frames; `macro` is the mean over the classes.
    NaN if no frame of a draw has a value.
    """
    weights = np.ones((1, len(scores))) if weights is None else np.asarray(weights, np.float64)
    precision, recall, f1 = _rates(np.einsum("bf,fkc->bkc", weights, scores.counts))
    values_by_name = {"dense_macro_f1": f1[:, :2].mean(axis=1)}
    for index, name in enumerate(COUNTED):
        prefix = f"dense_{name}" if index < len(PathClass) else name
        values_by_name |= {f"{prefix}_precision": precision[:, index], f"{prefix}_recall": recall[:, index]}
        values_by_name[f"{prefix}_f1"] = f1[:, index]
    values_by_name |= _distance_measures(scores.distances, weights)
    # a draw without any frame of a group has no value for the group
    drawn = weights.sum(axis=1) > 0.0
    return {name: np.where(drawn, values, np.nan) for name, values in values_by_name.items()}


def _rates(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return precision, recall and F1 of summed counts [..., 3], with `metrics.Counts`' values for empty sums."""
    true, false, missed = np.moveaxis(counts, -1, 0)
    wrong = false + missed
    precision = np.divide(true, true + false, out=np.zeros_like(true), where=true + false > 0)
    recall = np.divide(true, true + missed, out=np.zeros_like(true), where=true + missed > 0)
    f1 = np.divide(2.0 * true, 2.0 * true + wrong, out=np.ones_like(true), where=wrong > 0)
    return precision, recall, f1


def _distance_measures(distances: np.ndarray, weights: np.ndarray) -> dict[str, np.ndarray]:
    """Return means over frames of each distance, and the shares of frames with one side or both empty."""
    finite = np.isfinite(distances[..., 0])
    mean = [_mean(np.where(finite, distances[..., unit], 0.0), finite, weights) for unit in (0, 1)]
    always = np.ones_like(finite)
    mean += [_mean(distances[..., unit], always, weights) for unit in (2, 3)]
    values_by_name = {}
    for unit, values in zip(("m", "m2", "capped_m", "capped_m2"), mean, strict=True):
        values_by_name[f"dense_macro_chamfer_{unit}"] = values[:, :2].mean(axis=1)
        values_by_name |= {f"recovered_chamfer_{unit}": values[:, 2], f"hidden_chamfer_{unit}": values[:, 3]}
    one_empty, both_empty = np.isposinf(distances[..., 0]), np.isnan(distances[..., 0])
    for name, frames in (("infinite", one_empty), ("nothing", both_empty)):
        share = _mean(frames.astype(float), always, weights)
        values_by_name[f"dense_{name}_share"] = share[:, :2].mean(axis=1)
        values_by_name |= {f"recovered_{name}_share": share[:, 2], f"hidden_{name}_share": share[:, 3]}
    return values_by_name


def _mean(values: np.ndarray, valid: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return weighted means [B, K] of values [F, K] over the valid frames; NaN without any."""
    total = weights @ valid
    return np.divide(weights @ values, total, out=np.full(total.shape, np.nan), where=total > 0.0)


def bootstrap_weights(frames: int, draws: int, seed: int) -> np.ndarray:
    """Return how often each frame is drawn, [draws, frames]: as many frames as there are, with replacement.

    Methods compared under the same weights are compared on the same draws. Raises `ValueError` without frames or draws.
    """
    if frames < 1 or draws < 1:
        raise ValueError(f"frames and draws must be at least 1, got {frames} and {draws}")
    rng = np.random.default_rng(seed)
    return rng.multinomial(frames, np.full(frames, 1.0 / frames), size=draws).astype(np.float64)


@dataclass(frozen=True)
class Estimate:
    """A measure over all frames with its percentile interval (95 %); NaN without a value."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


def estimates(scores: FrameScores, weights: np.ndarray) -> dict[str, Estimate]:
    """Return every measure with its interval over draws [B, F]."""
    return estimated(measures(scores), measures(scores, weights))


def differences(scores: FrameScores, other: FrameScores, weights: np.ndarray) -> dict[str, Estimate]:
    """Return every measure of `scores` minus that of `other`, paired: both on the same draws."""
    first, second = measures(scores), measures(other)
    first_draws, second_draws = measures(scores, weights), measures(other, weights)
    return estimated(
        {name: first[name] - second[name] for name in first},
        {name: first_draws[name] - second_draws[name] for name in first},
    )


def estimated(values: Mapping[str, np.ndarray], draws: Mapping[str, np.ndarray]) -> dict[str, Estimate]:
    """Return measures by name [1] with the intervals of their draws [B]."""
    return {name: Estimate(float(value[0]), *_interval(draws[name])) for name, value in values.items()}


def _interval(draws: np.ndarray) -> tuple[float, float]:
    """Return the percentiles of the draws that have a value."""
    finite = draws[np.isfinite(draws)]
    if len(finite) == 0:
        return float("nan"), float("nan")
    low, high = np.percentile(finite, INTERVAL)
    return float(low), float(high)
