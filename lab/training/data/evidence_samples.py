"""Training samples of the evidence network: evidence of a scan in the bird's-eye view, and the objects it may show."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.training.data.frames import Frame, FrameLabels
from models.perception.mirrors.mirror_table import WallArrays, mirrors_met
from models.perception.see.detections import CLASSES
from models.perception.see.scan_evidence import ScanEvidence
from msgs.values.array_table import ArrayTable
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass, TruthObject

#: An object is asked for where a single mirror shows it at this SNR; fainter ones are neither asked for nor denied.
ASKED_DB = 12.0
#: A wall leads to an object if it folds one of its louder images to within this.
LED_M, LOUDER = 1.5, 0.1
#: Scale of the whole numbers in which channels are kept.
SCALE = 127.0


@dataclass(frozen=True)
class EvidenceObjects(ArrayTable):
    """Objects out of sight of one scan, N of them: what a network is to say of each."""

    #: Place of what mirrors show of it [N, 2]; centre of its box [N, 2]; logarithms of length and width [N, 2]; cosine
    #: and sine of twice its heading [N, 2]; all float32.
    place_m: np.ndarray
    centre_m: np.ndarray
    log_size: np.ndarray
    heading: np.ndarray
    #: Index into `CLASSES`; number in the scan's truth; int64 [N].
    object_class: np.ndarray
    number: np.ndarray
    #: It is to be found; others are neither to be found nor false. Bool [N].
    asked: np.ndarray


def quantized(channels: np.ndarray) -> np.ndarray:
    """Return channels as whole numbers, int8."""
    return np.clip(np.rint(SCALE * channels), -SCALE, SCALE).astype(np.int8)


def evidence_objects(frame: Frame, evidence: ScanEvidence) -> EvidenceObjects:
    """Return what a scan could show of its objects; raises `ValueError` where it does not say them."""
    if frame.truth is None:
        raise ValueError(f"scan {frame.index} must say its objects, as drives and `sim dataset --truth` do")
    elapsed_s = 1e-9 * (frame.ra_map.stamps_at(frame.labels.azimuth_rad) - frame.ra_map.stamp_ns)
    rows = [
        row
        for number, true_object in enumerate(frame.truth)
        if (row := _row(number, true_object, frame, evidence.arrays, elapsed_s)) is not None
    ]
    table = np.array(rows, np.float64).reshape(-1, 11)
    values = [table[:, first : first + 2].astype(np.float32) for first in (0, 2, 4, 6)]
    place_m, centre_m, log_size, heading = values
    kind, number = table[:, 8:10].T.astype(np.int64)
    return EvidenceObjects(place_m, centre_m, log_size, heading, kind, number, table[:, 10] > 0.5)


def _row(
    number: int, true_object: TruthObject, frame: Frame, walls: WallArrays, elapsed_s: np.ndarray
) -> tuple[float, ...] | None:
    labels = frame.labels
    own = labels.object_index == number
    if (not true_object.hidden and own.any()) or true_object.object_class not in CLASSES:
        return None
    heading = math.cos(2.0 * true_object.yaw_rad), math.sin(2.0 * true_object.yaw_rad)
    log_size = math.log(true_object.length_m), math.log(true_object.width_m)
    kind = CLASSES.index(true_object.object_class)
    centre_m = np.array([true_object.x_m, true_object.y_m])
    images = own & (labels.path_class == PathClass.MIRRORED)
    if not images.any():
        return (*centre_m, *centre_m, *log_size, *heading, kind, number, 0.0)
    weight = np.sqrt(labels.power_mw[images].astype(np.float64))
    places_m = labels.hidden_xy_m[images].astype(np.float64)
    place_m = weight @ places_m / weight.sum()
    moved_s = float(weight @ elapsed_s[images] / weight.sum())
    centre_m = centre_m + moved_s * np.array([true_object.velocity_x_mps, true_object.velocity_y_mps])
    singles = images & (labels.order == 1)
    asked = singles.any() and bool(led(labels, singles, walls, LED_M).any())
    if asked:
        asked = 10.0 * math.log10(labels.power_mw[singles].max() / frame.noise_power_mw) >= ASKED_DB
    return (*place_m, *centre_m, *log_size, *heading, kind, number, float(asked))


def led(labels: FrameLabels, images: np.ndarray, walls: WallArrays, within_m: float) -> np.ndarray:
    """Return which walls fold one of the louder of some images (bool [labels]) to within so much of its place."""
    power_mw = labels.power_mw[images]
    loud = np.flatnonzero(images)[power_mw >= LOUDER * power_mw.max()]
    image_m = xy_from_polar(labels.range_m[loud].astype(np.float64), labels.azimuth_rad[loud].astype(np.float64))
    place_m = labels.hidden_xy_m[loud].astype(np.float64)
    leads = np.zeros(len(walls), bool)
    for wall in range(len(walls)):
        normal, offset_m = mirrors_met(image_m, np.full(len(image_m), wall), walls)
        height_m = np.sum(image_m * normal, axis=1) + offset_m
        folded_m = image_m - 2.0 * height_m[:, None] * normal
        chord = (walls.b[wall] - walls.a[wall]) / max(float(walls.length_m[wall]), 1e-9)
        share = offset_m / np.maximum(offset_m - height_m, 1e-6)
        along_m = (share[:, None] * image_m - walls.a[wall]) @ chord
        reaches = (along_m > -8.0) & (along_m < walls.length_m[wall] + 8.0)
        leads[wall] = bool((reaches & (np.hypot(*(folded_m - place_m).T) < within_m)).any())
    return leads


def joined_objects(objects: Sequence[EvidenceObjects]) -> tuple[EvidenceObjects, np.ndarray]:
    """Return the objects of several scans in one table, and the scan of each, int64 [N]."""
    scan = np.repeat(np.arange(len(objects)), [len(item.number) for item in objects])
    return EvidenceObjects.joined(objects), scan
