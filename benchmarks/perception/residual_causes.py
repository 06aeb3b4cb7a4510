"""What a residual correction could mend: errors of the published back end's positions, by cause and kind of scene.

    python -m benchmarks.perception.residual_causes DIR [--split validation] [--limit N] [--json]

DIR is a data set of `sim dataset`. Folding about a wall keeps lengths, so the error of a position divides exactly: the
image's own (the peak against the true image) and the wall's (the true image folded by that wall against the true
position). What lies further off than `REACH_M` was reflected by another wall. F1 within 1 m bounds what any correction
can be worth: as it is, with ResidualReflectNet, and with each part of the error known.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lab.measures.point_scores import Counts, match_points, recovered_counts
from lab.training.data.frames import DataSet, Frame, FrameLabels, fixed_splits
from lab.training.data.residual_samples import GATE_M, fold_published, true_images
from models.perception.cards import learned_path
from models.perception.find.detectors import NetworkDetector
from models.perception.mirrors.residual_model import LearnedResidual

REACH_M = 5.0
KINDS = {"all": "", "with a curved wall": "curved_wall", "with a hedge": "hedge", "with a rough facade": "facade"}
ERRORS = ("image", "wall")


@dataclass(frozen=True)
class Places:
    """Recovered positions [N, 2] of one scene, the parts of their errors (NaN: no true image), and all truth."""

    relays: tuple[str, ...]
    place_m: np.ndarray
    shift_m: np.ndarray
    image_error_m: np.ndarray
    wall_error_m: np.ndarray
    order: np.ndarray
    truth_m: np.ndarray

    @property
    def error_m(self) -> np.ndarray:
        """Distance of each position from the true one."""
        return np.linalg.norm(self.image_error_m + self.wall_error_m, axis=1)

    def moved(self, bound: str) -> np.ndarray:
        """Return the positions with one correction."""
        near = (self.error_m <= REACH_M)[:, None]
        shift = {
            "as folded": np.zeros_like(self.place_m),
            "ResidualReflectNet": self.shift_m,
            "wall known within reach": np.where(near, self.wall_error_m, 0.0),
            "all known within reach": np.where(near, self.wall_error_m + self.image_error_m, 0.0),
            "every wall known": np.nan_to_num(self.wall_error_m),
        }
        return self.place_m + shift[bound]


BOUNDS = ("as folded", "ResidualReflectNet", "wall known within reach", "all known within reach", "every wall known")


def places(frame: Frame, detector: NetworkDetector, residual: LearnedResidual) -> Places:
    """Return what the published back end makes of one scene."""
    recovered, reflection = fold_published(detector.detect(frame.ra_map))
    parts = errors(recovered.images_m, recovered.points_m, frame.labels)
    return Places(frame.relays, recovered.points_m, residual(reflection), *parts)


def errors(
    image_m: np.ndarray, place_m: np.ndarray, labels: FrameLabels
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return both parts of the errors of images folded to places [N, 2], mirrors of the true images [N], and all truth.

    The parts point from a place to the true one and are NaN where no true image is near.
    """
    truth, true_images_m = true_images(labels)
    truth_m = truth.hidden_xy_m.astype(np.float64)
    image_error_m, wall_error_m = np.full((2, len(image_m), 2), np.nan)
    order = np.zeros(len(image_m), np.int64)
    for image, true in match_points(image_m, true_images_m, GATE_M):
        folded_m = _mirrored(true_images_m[true], image_m[image], place_m[image])
        image_error_m[image] = folded_m - place_m[image]
        wall_error_m[image] = truth_m[true] - folded_m
        order[image] = truth.order[true]
    return image_error_m, wall_error_m, order, truth_m


def _mirrored(point_m: np.ndarray, image_m: np.ndarray, place_m: np.ndarray) -> np.ndarray:
    """Return a point mirrored as `image_m` was to `place_m`: about the line half-way between them, if it was at all."""
    across = image_m - place_m
    if not across.any():
        return point_m
    normal = across / np.linalg.norm(across)
    return np.asarray(point_m - 2.0 * (point_m - (image_m + place_m) / 2.0) @ normal * normal)


def rows(scenes: list[Places]) -> Iterator[dict[str, object]]:
    """Yield what is said of each kind of scene."""
    for kind, relay in KINDS.items():
        chosen = [scene for scene in scenes if not relay or relay in scene.relays]
        if not chosen:
            continue
        error_m = np.concatenate([scene.error_m for scene in chosen])
        near = error_m <= REACH_M
        shares = {
            "no true image": np.isnan(error_m),
            "within 1 m": error_m <= 1.0,
            "1 to 5 m": near & (error_m > 1.0),
            "further, by two mirrors": (error_m > REACH_M) & (np.concatenate([scene.order for scene in chosen]) > 1),
            "further, by one": (error_m > REACH_M) & (np.concatenate([scene.order for scene in chosen]) == 1),
        }
        row: dict[str, object] = {"scenes": kind, "count": len(chosen), "positions": len(error_m)}
        row |= {name: round(float(mask.mean()), 3) for name, mask in shares.items()}
        for part in ERRORS:
            parts_m = np.concatenate([getattr(scene, f"{part}_error_m") for scene in chosen])[near]
            sizes_m = np.linalg.norm(parts_m, axis=1)
            row[f"{part} error p50, p90 [m]"] = [round(float(value), 2) for value in np.quantile(sizes_m, (0.5, 0.9))]
        before_m = np.concatenate([scene.image_error_m + scene.wall_error_m for scene in chosen])[near]
        shift_m = np.concatenate([scene.shift_m for scene in chosen])[near]
        row["squared error explained"] = round(1.0 - float(np.sum((before_m - shift_m) ** 2) / np.sum(before_m**2)), 3)
        for bound in BOUNDS:
            total = sum((recovered_counts(scene.moved(bound), scene.truth_m) for scene in chosen), Counts())
            row[f"F1 {bound}"] = round(total.f1, 3)
        yield row


def main() -> None:
    """Print a table of the causes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--split", default="validation")
    parser.add_argument("--limit", type=int)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    data = DataSet(arguments.data)
    detector = NetworkDetector(data.setup, learned_path("swin_unet.compact"))
    residual = LearnedResidual(learned_path("residual_reflect_net"))
    indices = fixed_splits(arguments.data).of(arguments.split)[: arguments.limit]
    scenes = [places(frame, detector, residual) for frame in data.frames(indices)]
    table = list(rows(scenes))
    if arguments.json:
        print(json.dumps(table, indent=1))
        return
    for name in table[0]:
        print(f"{name:34}", *(f"{row[name]!s:>20}" for row in table))


if __name__ == "__main__":
    main()
