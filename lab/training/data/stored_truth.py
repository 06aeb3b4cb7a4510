"""Truth of a stored scan: what scoring and training need of it beside what the radar saw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.measures.object_rows import ImageTruth
from lab.training.data.frames import FrameLabels
from models.perception.mirrors.mirror_table import WallArrays
from msgs.values.perception import PathClass, SceneTruth, TruthObject


@dataclass(frozen=True)
class ScanTruth:
    """What the scoring of a scan needs: walls and the mirror of each place, labels, true objects, times of azimuths."""

    walls: WallArrays
    mirror: np.ndarray
    labels: FrameLabels
    truth: tuple[TruthObject, ...]
    #: Of a beam, per range bin, as the data set says it.
    noise_power_mw: float
    #: Acquisition time of each azimuth after the truth's, int64 [azimuths].
    azimuth_stamp_ns: np.ndarray
    #: The vehicle's motion was taken out of the map.
    ego_compensated: bool
    #: The view's observability mask.
    visibility: np.ndarray


def scan_truth(scan: int, stored: ScanTruth) -> SceneTruth:
    """Return the truth of a scan as far as the labels tell it."""
    labels = stored.labels
    images = np.flatnonzero((labels.path_class == PathClass.MIRRORED) & (labels.object_index >= 0))
    polar = labels.range_m[images], labels.azimuth_rad[images]
    image_m = np.stack([polar[0] * np.cos(polar[1]), polar[0] * np.sin(polar[1]), np.zeros(len(images))], axis=1)
    true_m = np.column_stack([labels.hidden_xy_m[images], np.zeros(len(images))])
    return SceneTruth(
        stamp_ns=0,
        scan_id=scan,
        los_points_m=np.zeros((0, 3), np.float32),
        mirrored_points_m=image_m.astype(np.float32),
        hidden_points_m=true_m.astype(np.float32),
        hidden_object=labels.object_index[images].astype(np.int32),
        objects=stored.truth,
    )


def image_truths(stored: ScanTruth) -> list[ImageTruth]:
    """Return what the labels tell of each object's images; those under 10 dB have no label.

    An object beside the radar's sector is in sight although no label of the map shows it.
    """
    labels, snr_db = stored.labels, 10.0 * np.log10(stored.labels.power_mw / stored.noise_power_mw)
    return [
        _image(labels, snr_db, labels.object_index == number, true_object.hidden)
        for number, true_object in enumerate(stored.truth)
    ]


def _image(labels: FrameLabels, snr_db: np.ndarray, own: np.ndarray, hidden: bool) -> ImageTruth:
    mirrored = own & (labels.path_class == PathClass.MIRRORED)
    return ImageTruth(
        direct=not hidden and bool(own.any()),
        mirrored=bool(mirrored.any()),
        snr_db=_strongest(snr_db[mirrored]),
        single_snr_db=_strongest(snr_db[mirrored & (labels.order == 1)]),
    )


def _strongest(snr_db: np.ndarray) -> float | None:
    return float(snr_db.max()) if len(snr_db) else None
