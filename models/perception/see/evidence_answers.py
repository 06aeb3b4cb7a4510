"""Answers of the evidence network: what it says of each place, and the objects that are read off it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logit

from models.perception.find.score_calibration import ScoreTable, score_of
from models.perception.mirrors.mirror_table import RADAR, WallArrays, hits
from models.perception.see.detections import (
    CENTRE,
    CLASS,
    HEADING,
    LOG_SIZE,
    LOG_SIZE_LIMITS,
    LOG_STD,
    LOG_STD_LIMITS,
    PLACE,
    Detections,
    distinct,
)
from models.perception.see.gathering import BirdsEyeGrid
from models.physics.mirror import reflect
from msgs.values.array_table import ArrayTable

#: Share of a threshold that no rounding of a probability reaches.
ROUNDING = 1.0 - 1e-9


@dataclass(frozen=True)
class Candidates(ArrayTable):
    """Places that may hold an object, N of them: their cells, what is answered there, and their likeliest mirrors."""

    row: np.ndarray
    column: np.ndarray
    #: float64 [N, answers].
    values: np.ndarray
    wall: np.ndarray


def candidates(answer: np.ndarray, mirror: np.ndarray, least: float) -> Candidates:
    """Return the places of an answer [answers, x, y] that are likelier than their neighbours and than `least`.

    `mirror` [x, y]: index of the likeliest wall, -1: none shows the place.
    """
    row, column = _peaks(np.where(mirror >= 0, answer[0], -np.inf), least)
    return Candidates(row, column, answer[:, row, column].T.astype(np.float64), mirror[row, column].astype(np.int64))


def evidence_detections(proposals: Candidates, grid: BirdsEyeGrid, walls: WallArrays, threshold: float) -> Detections:
    """Return the different objects among candidates over a threshold, best first."""
    likely = proposals.take(proposals.values[:, 0] >= logit(ROUNDING * threshold))
    reports = detections_of(likely, grid, walls)
    return reports.take(distinct(reports, np.abs(reports.place_m[:, 1])))


def detections_of(proposals: Candidates, grid: BirdsEyeGrid, walls: WallArrays) -> Detections:
    """Return all candidates as detections, in their order."""
    values = proposals.values
    place_m = np.stack([grid.x_m[proposals.row], grid.y_m[proposals.column]], axis=1) + values[:, PLACE]
    image_m, away = _image(place_m, proposals.wall, walls)
    axes = np.stack([away, np.stack([-away[:, 1], away[:, 0]], axis=1)], axis=2)
    std_m = np.exp(np.clip(values[:, LOG_STD], *LOG_STD_LIMITS))
    return Detections(
        score=expit(values[:, 0]),
        place_m=place_m,
        covariance_m2=(axes * std_m[:, None] ** 2) @ axes.transpose(0, 2, 1),
        centre_m=place_m + values[:, CENTRE],
        size_m=np.exp(np.clip(values[:, LOG_SIZE], *LOG_SIZE_LIMITS)),
        yaw_rad=0.5 * np.arctan2(values[:, HEADING][:, 1], values[:, HEADING][:, 0]),
        object_class=values[:, CLASS].argmax(axis=1),
        range_m=np.hypot(*image_m.T),
        azimuth_rad=np.arctan2(image_m[:, 1], image_m[:, 0]),
        away_rad=np.arctan2(away[:, 1], away[:, 0]),
    )


def _peaks(object_logit: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the places that are the likeliest among their neighbours."""
    padded = np.pad(object_logit, 1, constant_values=-np.inf)
    likely = np.argwhere(object_logit >= logit(ROUNDING * threshold))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    about = windows[tuple(likely.T)]
    kept = likely[about[:, 1, 1] >= about.max(axis=(1, 2), initial=-np.inf)]
    return kept[:, 0], kept[:, 1]


def _image(place_m: np.ndarray, wall: np.ndarray, walls: WallArrays) -> tuple[np.ndarray, np.ndarray]:
    """Return the images [N, 2] of places [N, 2] in walls [N], and the directions of the ways on at the places."""
    image_m = reflect(place_m, walls.normal[wall], walls.offset_m[wall])
    if len(place_m) and walls.curvature_per_m[wall].any():
        # as the tangent that the ray meets, by a few steps from the chord
        for _ in range(4):
            normal, offset_m = hits(RADAR, image_m, walls).mirrors(wall, walls)
            image_m = reflect(place_m, normal, offset_m)
    else:
        normal, offset_m = walls.normal[wall], walls.offset_m[wall]
    height_m = np.sum(image_m * normal, axis=1) + offset_m
    share = offset_m / np.where(np.abs(offset_m - height_m) > 1e-6, offset_m - height_m, 1e-6)
    away = place_m - share[:, None] * image_m
    length_m = np.hypot(*away.T)
    return image_m, away / np.maximum(length_m, 1e-9)[:, None]


def least_answer(table: ScoreTable, probability: float, logits: Sequence[float]) -> float:
    """Return the least answer whose report may reach a probability, by a table and the largest of `logits`."""
    unshifted = shifted(np.array([probability]), np.array([-max(0.0, *logits)]))
    return score_of(table, float(unshifted[0]))


def shifted(probability: np.ndarray, logits: np.ndarray) -> np.ndarray:
    """Return probabilities [N] moved by logits [N]; those of 0 and 1 stay."""
    return np.asarray(expit(logit(probability) + logits))
