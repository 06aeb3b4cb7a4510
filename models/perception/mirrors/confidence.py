"""Confidence of folded positions: a small network on features of the fold, fitted on simulated scenes.

It is the probability that the position lies within 1 m of a true one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit

from models.perception.cards import learned_path, read_card
from models.perception.mirrors.image_walls import CUT_DEPTH_M, DirectReturns, RayWallCrossings, RecoveryParams
from models.perception.mirrors.mirror_table import WallArrays, behind_walls, wall_arrays
from models.perception.mirrors.recovery import Recovered
from models.physics.plane import segment_distance_m
from msgs.values.frames import polar_from_xy
from msgs.values.perception import Wall

#: Confidence model of the committed network.
DEFAULT_CONFIDENCE = learned_path("compact_unet.confidence", ".json")
#: Distances are given as logarithms, clipped to these bounds.
NEAREST_M, FARTHEST_M = 0.2, 120.0
#: Positions this near each other belong to one object: by different walls, by the same wall.
SUPPORT_M, COMPANY_M = 1.0, 2.0
#: A direct return this near may be the same object.
SAME_OBJECT_M = 1.5
#: Upper bound of every feature and weight.
LARGEST = 1e3
#: Bound of standardised features: the model does not extrapolate far beyond the fitted range.
CLIP = 4.0


#: Features of a position, in order; distances without a unit are logarithms of metres.
FEATURES = (
    "score_logit", "snr_db", "image_range", "image_azimuth_rad", "image_sigma", "sigma",
    "missed_m", "depth", "to_wall", "incidence", "mirror_gap", "twice",
    "wall_length", "wall_angle_std_rad", "wall_curved", "wall_returns",
    "range", "azimuth_rad", "nearest_return", "nearest_loose_return", "return_louder_db", "nearest_wall", "behind_wall",
    "support", "company", "company_score", "places", "walls",
)  # fmt: skip


@dataclass(frozen=True)
class _FoldContext:
    """Folded positions of a scan with the walls and returns that their features are computed from."""

    recovered: Recovered
    walls: WallArrays
    returns: DirectReturns
    params: RecoveryParams

    @cached_property
    def image_sigma_m(self) -> np.ndarray:
        """Error of each image, almost all of it across its ray [N]."""
        return np.asarray(np.sqrt(np.trace(self.recovered.image_covariance_m2, axis1=1, axis2=2)))

    @cached_property
    def long_walls(self) -> WallArrays:
        """Walls too long for a vehicle's side."""
        return self.walls.take(self.walls.length_m > self.params.vehicle_length_m)


def _echo(context: _FoldContext) -> dict[str, np.ndarray]:
    """Return the features of the echo itself: its strength and apparent position."""
    recovered = context.recovered
    score = np.clip(recovered.score, 0.01, 0.99)
    range_m, azimuth_rad = polar_from_xy(recovered.images_m)
    return {
        "score_logit": np.log(score / (1.0 - score)),
        "snr_db": np.clip(recovered.snr_db, -10.0, 70.0),
        "image_range": _log(range_m),
        "image_azimuth_rad": np.abs(azimuth_rad),
        "image_sigma": _log(context.image_sigma_m),
        "sigma": _log(np.sqrt(np.trace(recovered.covariance_m2, axis1=1, axis2=2))),
    }


def _fold(context: _FoldContext) -> dict[str, np.ndarray]:
    """Return the features of the crossing of its ray with the wall and the distance to the wall's nearest return."""
    recovered, wall = context.recovered, context.recovered.wall
    range_m = np.maximum(np.hypot(recovered.images_m[:, 0], recovered.images_m[:, 1]), NEAREST_M)
    crossings = RayWallCrossings.of(recovered.images_m, context.image_sigma_m / range_m, context.walls)
    to_wall_m = np.clip(_at(crossings.to_wall_m, wall), 0.0, range_m)
    mirror_m = recovered.images_m * (to_wall_m / range_m)[:, None]
    gap_m = np.linalg.norm(mirror_m[:, None] - context.returns.points_m, axis=-1)
    gap_m = np.where(wall[:, None] == context.returns.wall, gap_m, FARTHEST_M).min(axis=1, initial=FARTHEST_M)
    sideways_m = np.maximum(_at(crossings.sideways_m, wall), NEAREST_M)
    return {
        "missed_m": np.clip(_at(crossings.missed_m, wall), 0.0, 4.0),
        "depth": _log(_at(crossings.depth_m, wall)),
        "to_wall": _log(to_wall_m),
        "incidence": np.clip(to_wall_m * context.image_sigma_m / range_m / sideways_m, 0.0, 1.0),
        "mirror_gap": _log(gap_m),
        "twice": recovered.second >= 0,
    }


def _mirror(context: _FoldContext) -> dict[str, np.ndarray]:
    """Return the features of the wall."""
    wall, walls = context.recovered.wall, context.walls
    returns = np.bincount(context.returns.wall[context.returns.wall >= 0], minlength=len(walls))
    return {
        "wall_length": _log(_at(walls.length_m, wall)),
        "wall_angle_std_rad": np.clip(_at(walls.angle_std_rad, wall), 0.0, 0.2),
        "wall_curved": _at(walls.curvature_per_m, wall) != 0.0,
        "wall_returns": np.log1p(_at(returns, wall)),
    }


def _surroundings(context: _FoldContext) -> dict[str, np.ndarray]:
    """Return the features of the surroundings: direct returns, walls, and whether a wall hides the position."""
    points_m, returns, walls = context.recovered.points_m, context.returns, context.long_walls
    range_m, azimuth_rad = polar_from_xy(points_m)
    distance_m = np.linalg.norm(points_m[:, None] - returns.points_m, axis=-1)  # [N, M]
    loose = ~np.append(context.walls.length_m > context.params.vehicle_length_m, False)[returns.wall]
    louder = np.where(distance_m < SAME_OBJECT_M, returns.snr_db - context.recovered.snr_db[:, None], -40.0)
    return {
        "range": _log(range_m),
        "azimuth_rad": np.abs(azimuth_rad),
        "nearest_return": _log(distance_m.min(axis=1, initial=FARTHEST_M)),
        "nearest_loose_return": _log(np.where(loose, distance_m, FARTHEST_M).min(axis=1, initial=FARTHEST_M)),
        "return_louder_db": np.clip(louder.max(axis=1, initial=-40.0), -40.0, 40.0),
        "nearest_wall": _log(segment_distance_m(points_m, walls.a, walls.b).min(axis=1, initial=FARTHEST_M)),
        "behind_wall": behind_walls(points_m, walls, CUT_DEPTH_M),
    }


def _company(context: _FoldContext) -> dict[str, np.ndarray]:
    """Return the features of other positions: by other walls at the same spot, by the same wall near, their number."""
    recovered = context.recovered
    distance_m = np.linalg.norm(recovered.points_m[:, None] - recovered.points_m, axis=-1)
    same = (recovered.wall[:, None] == recovered.wall) & (recovered.second[:, None] == recovered.second)
    support = np.where(same, 0.0, recovered.score * np.exp(-((distance_m / SUPPORT_M) ** 2)))
    mates = same & (distance_m < COMPANY_M) & ~np.eye(len(recovered), dtype=bool)
    return {
        "support": np.clip(support.max(axis=1, initial=0.0), 0.0, 1.0),
        "company": np.log1p(mates.sum(axis=1)),
        "company_score": np.clip(np.where(mates, recovered.score, 0.0).max(axis=1, initial=0.0), 0.0, 1.0),
        "places": np.full(len(recovered), math.log1p(len(recovered))),
        "walls": np.full(len(recovered), math.log1p(len(context.walls))),
    }


_PARTS: tuple[Callable[[_FoldContext], dict[str, np.ndarray]], ...] = (_echo, _fold, _mirror, _surroundings, _company)


def _log(metres: np.ndarray) -> np.ndarray:
    """Return the logarithm of distances, within bounds."""
    return np.asarray(np.log(np.clip(metres, NEAREST_M, FARTHEST_M)))


def _at(values: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """Return the values [W], or [N, W], at each position's wall [N]; zero for positions without one and for NaN."""
    padded = np.concatenate([values, np.zeros((*values.shape[:-1], 1))], axis=-1)
    return np.nan_to_num(padded[wall] if values.ndim == 1 else padded[np.arange(len(wall)), wall])


def position_features(
    recovered: Recovered, walls: list[Wall], returns: DirectReturns, params: RecoveryParams
) -> np.ndarray:
    """Return the features of each position, float64 [N, features], in the order of `FEATURES`."""
    context = _FoldContext(recovered, wall_arrays(walls), returns, params)
    columns = {name: column for part in _PARTS for name, column in part(context).items()}
    return np.stack([columns[name].astype(np.float64) for name in FEATURES], axis=1)


class PositionConfidence(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A fitted model: p = sigmoid(w . tanh(A z + a) + b) of standardised features z; `ValueError` names the field."""

    features: tuple[str, ...]
    means: tuple[float, ...]
    scales: tuple[float, ...]
    hidden_weights: tuple[tuple[float, ...], ...]
    hidden_biases: tuple[float, ...]
    weights: tuple[float, ...]
    bias: float
    #: Positions below are dropped; chosen for the best recovered F1 of the validation scenes.
    threshold: float
    #: `Peaks.detector` of the peaks it was fitted on; empty: of any.
    detector: str = ""
    seed: int = 0
    command: str = ""
    #: Made from which scenes, with which detector.
    data: dict[str, str | int] = {}
    #: On validation scenes; `_without` are those of all positions.
    metrics: dict[str, float] = {}

    def __post_init__(self) -> None:
        if self.features != FEATURES:
            raise ValueError(f"confidence.features must be {', '.join(FEATURES)}, got {', '.join(self.features)}")
        if not 0.0 < self.threshold < 1.0:
            raise ValueError(f"confidence.threshold must be between 0 and 1, got {self.threshold}")
        hidden, count = len(self.weights), len(FEATURES)
        shapes = {"means": (count,), "scales": (count,), "hidden_biases": (hidden,), "hidden_weights": (hidden, count)}
        for name, shape in {**shapes, "weights": (hidden,), "bias": ()}.items():
            _check_numbers(f"confidence.{name}", getattr(self, name), shape)
        if min(self.scales) <= 0.0:
            raise ValueError(f"confidence.scales must be positive, got {min(self.scales)}")

    def fits(self, detector: str) -> bool:
        """Return whether the model was fitted on peaks of this detector (`Peaks.detector`), or of any."""
        return self.detector in ("", detector)

    def of(self, detector: str) -> PositionConfidence | None:
        """Return itself where it was fitted on peaks of this detector."""
        return self if self.fits(detector) else None

    def probable(
        self, recovered: Recovered, walls: list[Wall], returns: DirectReturns, params: RecoveryParams
    ) -> Recovered:
        """Return the positions of a scan that reach the threshold, each with its probability as score."""
        probability = self.probability(position_features(recovered, walls, returns, params))
        return replace(recovered, score=probability).take(probability >= self.threshold)

    def probability(self, features: np.ndarray) -> np.ndarray:
        """Return the probability [N] of positions from features [N, features]; `ValueError` unless finite and sane."""
        if features.ndim != 2 or features.shape[1] != len(FEATURES):
            raise ValueError(f"features must have shape [N, {len(FEATURES)}], got {features.shape}")
        if not (np.abs(features) <= LARGEST).all():
            row, column = np.argwhere(~(np.abs(features) <= LARGEST))[0]
            raise ValueError(f"features must be within {LARGEST:g}, {FEATURES[column]} is {features[row, column]}")
        scaled = standardised(features, self.means, self.scales)
        hidden = np.tanh(scaled @ np.array(self.hidden_weights).T + self.hidden_biases)
        return np.asarray(expit(hidden @ np.array(self.weights) + self.bias))


def standardised(features: np.ndarray, means: ArrayLike, scales: ArrayLike) -> np.ndarray:
    """Return the features [N, F] in units of their spread, clipped."""
    return np.clip((features - np.asarray(means)) / np.asarray(scales), -CLIP, CLIP)


def _check_numbers(name: str, values: object, shape: tuple[int, ...]) -> None:
    """Raise `ValueError` unless the values, maybe nested, have this shape and are finite and of sane size."""
    try:
        array = np.array(values, np.float64)
    except ValueError:
        raise ValueError(f"{name} must have shape {shape}, rows are of different lengths") from None
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    if not (np.abs(array) <= LARGEST).all():
        raise ValueError(f"{name} must be finite and within {LARGEST:g}")


@dataclass(frozen=True)
class FittedConfidences:
    """Models of several detectors; the peaks of each detector use its own model."""

    models: tuple[PositionConfidence, ...]

    def of(self, detector: str) -> PositionConfidence | None:
        """Return the first model fitted on peaks of this detector."""
        return next((model for model in self.models if model.fits(detector)), None)


#: Models that the geometry stage accepts.
Confidence = PositionConfidence | FittedConfidences


def load_confidence(path: Path) -> PositionConfidence:
    """Read a fitted model; raises `ValueError` naming the file and the field that is wrong."""
    return read_card(Path(path), PositionConfidence)
