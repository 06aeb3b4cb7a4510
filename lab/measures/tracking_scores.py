"""Standard scores of tracks, by the distance of centres: MOTA, IDF1, HOTA with its parts.

MOTA: Bernardin and Stiefelhagen 2008. IDF1: Ristani et al. 2016. HOTA: Luiten et al. 2021, Eqs. (8) to (20), with
similarity 1 - distance / gate. Every drive is reduced to sums, which add over drives: so do those of bootstrap draws.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np
from scipy.optimize import linear_sum_assignment

from lab.measures.frame_scores import Estimate, estimated
from lab.measures.object_rows import FALSE_M, ScanRow

#: A track and an object so far apart, or further, do not match (as in nuScenes tracking).
GATE_M = FALSE_M
#: Similarities from which HOTA counts a pair.
ALPHAS = np.arange(1, 20) / 20.0
#: Room for the rounding of a similarity; and worth of a pair of the scan before, over that of any others.
_ROUNDING, _STAYS = 1e-12, 1000.0


class TrackingScores(msgspec.Struct, frozen=True, kw_only=True):
    """Standard scores with intervals; NaN where there is nothing to score."""

    #: 1 - (misses + false reports + changes of identity) / objects, scan by scan.
    mota: Estimate
    #: F1 of the reports under the best assignment of whole tracks to whole objects.
    idf1: Estimate
    #: Mean over `ALPHAS` of the root of detection times association accuracy; then either, and localisation accuracy.
    hota: Estimate
    deta: Estimate
    assa: Estimate
    loca: Estimate


def tracking_scores(drives: Sequence[Sequence[ScanRow]], weights: np.ndarray) -> TrackingScores:
    """Score the tracks of drives against the hidden objects that a mirror shows; `weights` [B, drives] are draws."""
    sums = np.array([drive_sums(scans) for scans in drives])
    return TrackingScores(**estimated(_scores(sums.sum(axis=0)[None]), _scores(weights @ sums)))


def drive_sums(scans: Sequence[ScanRow]) -> np.ndarray:
    """Return the sums of a drive: objects, tracks, then misses, false reports and identity changes of MOTA, matches of
    IDF1; of HOTA the matches, their association accuracies and their similarities, each at all `ALPHAS`.
    """
    objects = [{row.object_id: row.at_m for row in scan.hidden if row.image.mirrored} for scan in scans]
    tracks = [{row.id: row.at_m for row in scan.tracks} for scan in scans]
    object_rows, track_rows = _rows(objects), _rows(tracks)
    object_counts, track_counts = _counts(object_rows), _counts(track_rows)
    # of each scan: its cells of a table of all tracks and all objects of the drive, and the similarities there
    cells = [np.ix_(*rows) for rows in zip(track_rows, object_rows, strict=True)]
    similarities = [_similarity(*at_m) for at_m in zip(tracks, objects, strict=True)]
    shape = (len(track_counts), len(object_counts))
    together, overlap = np.zeros(shape), np.zeros(shape)
    for at, similarity in zip(cells, similarities, strict=True):
        together[at] += similarity > 0.0
        either = similarity.sum(axis=0) + similarity.sum(axis=1, keepdims=True) - similarity
        overlap[at] += np.divide(similarity, either, out=np.zeros_like(either), where=either > 0.0)
    both_counts = track_counts[:, None] + object_counts
    alignment = overlap / (both_counts - overlap)
    matches, similarity_sums = np.zeros((len(ALPHAS), *shape)), np.zeros(len(ALPHAS))
    for at, similarity in zip(cells, similarities, strict=True):
        pairs = linear_sum_assignment(-alignment[at] * similarity)
        reached = similarity[pairs] >= ALPHAS[:, None] - _ROUNDING
        matches[:, at[0][pairs[0], 0], at[1][0, pairs[1]]] += reached
        similarity_sums += reached @ similarity[pairs]
    accuracies = (matches**2 / np.maximum(both_counts - matches, 1.0)).sum(axis=(1, 2))
    clear = _clear_counts(object_rows, track_rows, similarities)
    matched = together[linear_sum_assignment(-together)].sum()
    counts = (object_counts.sum(), track_counts.sum(), *clear, matched)
    return np.concatenate([counts, matches.sum(axis=(1, 2)), accuracies, similarity_sums])


def _clear_counts(
    object_rows: Sequence[np.ndarray], track_rows: Sequence[np.ndarray], similarities: Sequence[np.ndarray]
) -> tuple[int, int, int]:
    """Return misses, false reports and changes of identity; a pair of the scan before stays while it is in the gate."""
    misses = false = changes = 0
    before: dict[int, int] = {}
    last: dict[int, int] = {}
    for objects, tracks, similarity in zip(object_rows, track_rows, similarities, strict=True):
        stays = np.array([before.get(row, -1) for row in objects.tolist()], np.int64) == tracks[:, None]
        value = np.where(similarity > 0.0, similarity + _STAYS * stays, 0.0)
        rows, columns = linear_sum_assignment(-value)
        paired = value[rows, columns] > 0.0
        before = dict(zip(objects[columns[paired]].tolist(), tracks[rows[paired]].tolist(), strict=True))
        changes += sum(last.get(row, track) != track for row, track in before.items())
        last |= before
        misses += len(objects) - len(before)
        false += len(tracks) - len(before)
    return misses, false, changes


def _rows(scans: Sequence[dict[int, tuple[float, float]]]) -> list[np.ndarray]:
    """Return of each scan the numbers of its ids among those of the drive."""
    rows = {key: row for row, key in enumerate(dict.fromkeys(key for scan in scans for key in scan))}
    return [np.array([rows[key] for key in scan], np.int64) for scan in scans]


def _counts(rows: Sequence[np.ndarray]) -> np.ndarray:
    return np.bincount(np.concatenate([np.zeros(0, np.int64), *rows]))


def _similarity(tracks: dict[int, tuple[float, float]], objects: dict[int, tuple[float, float]]) -> np.ndarray:
    at_m, true_m = (np.array(list(each.values()), np.float64).reshape(-1, 2) for each in (tracks, objects))
    distance_m = np.linalg.norm(at_m[:, None] - true_m, axis=-1)
    return np.maximum(1.0 - distance_m / GATE_M, 0.0)


def _scores(sums: np.ndarray) -> dict[str, np.ndarray]:
    """Return the scores [B] of sums [B, ...] as `drive_sums`."""
    objects, tracks, misses, false, changes, matched = sums[:, :6].T
    matches, association, similarities = np.split(sums[:, 6:], 3, axis=1)
    deta = _quotient(matches, objects[:, None] + tracks[:, None] - matches)
    assa = np.where(matches > 0.0, _quotient(association, matches), 0.0)
    return {
        "mota": 1.0 - _quotient(misses + false + changes, objects),
        "idf1": _quotient(2.0 * matched, objects + tracks),
        "hota": np.sqrt(deta * assa).mean(axis=1),
        "deta": deta.mean(axis=1),
        "assa": assa.mean(axis=1),
        # as the authors' code has it, 1 where nothing matches so closely
        "loca": np.where(matches > 0.0, _quotient(similarities, matches), 1.0).mean(axis=1),
    }


def _quotient(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    return np.divide(part, whole, out=np.full(np.shape(whole), np.nan), where=whole > 0.0)
