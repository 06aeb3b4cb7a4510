"""Matching of hidden objects with truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from models.scores.object_error import object_distances
from msgs.values.perception import HiddenObject, SceneTruth

#: Cost of a forbidden pair: larger than any sum of allowed ones.
FORBIDDEN = 1e9


def assign_within(distance_m: np.ndarray, gate_m: float) -> np.ndarray:
    """Assign rows to columns one to one within a gate: as many as possible, then the nearest; pairs [K, 2]."""
    if distance_m.size == 0:
        return np.zeros((0, 2), np.int64)
    rows, columns = linear_sum_assignment(np.where(distance_m <= gate_m, distance_m, FORBIDDEN))
    allowed = distance_m[rows, columns] <= gate_m
    return np.stack([rows[allowed], columns[allowed]], axis=1)


@dataclass(frozen=True)
class ObjectMatch:
    """Hidden objects compared with truth: pairs with errors, false objects, missed hidden truths."""

    #: (id of the object, id of the truth, face error in metres: `models.scores.object_error`).
    matched: tuple[tuple[int, int, float], ...]
    #: Centre error of each pair in metres.
    centre_m: tuple[float, ...]
    unmatched_objects: tuple[int, ...]
    missed_truths: tuple[int, ...]


def match_objects(objects: Sequence[HiddenObject], truth: SceneTruth, gate_m: float = 1.0) -> ObjectMatch:
    """Match hidden truths, moved to the time an object was measured, one to one by the face error."""
    hidden = [item for item in truth.objects if item.hidden]
    distances = object_distances(objects, truth, hidden)
    pairs = assign_within(distances.error_m, gate_m)
    return ObjectMatch(
        matched=tuple((objects[i].id, hidden[j].id, float(distances.error_m[i, j])) for i, j in pairs),
        centre_m=tuple(float(distances.centre_m[i, j]) for i, j in pairs),
        unmatched_objects=tuple(item.id for i, item in enumerate(objects) if i not in pairs[:, 0]),
        missed_truths=tuple(item.id for j, item in enumerate(hidden) if j not in pairs[:, 1]),
    )
