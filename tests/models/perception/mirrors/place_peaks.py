"""Peaks of seeded places without a detector."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from models.perception.find.peaks import PeakParams, polar_covariance
from models.perception.mirrors.observability import sensitivity_db
from msgs.values.perception import Peaks
from msgs.values.radar import RadarSetup, RangeAzimuthGrid
from sim_player.dataset.labelled_scan import labelled_scan
from sim_player.generate.places import random_place


def place_peaks(seed: int, count: int) -> Iterator[Peaks]:
    """Labels of seeded places at rest as peaks, with the polar errors of good ones (0.06 m, 0.7 deg)."""
    for index in range(count):
        scan = labelled_scan(random_place(seed, index), seed, "basic")
        labels, rng = scan.labels, np.random.default_rng([seed, index])
        snr_db = 10.0 * np.log10(np.maximum(labels.power_mw.astype(np.float64) / scan.noise_power_mw, 1e-3))
        range_error_m, azimuth_error_rad = rng.standard_normal((2, len(snr_db))) * [[0.06], [np.radians(0.7)]]
        yield Peaks(
            stamp_ns=0,
            scan_id=index,
            range_m=np.maximum(labels.range_m + range_error_m, 0.0),
            azimuth_rad=labels.azimuth_rad + azimuth_error_rad,
            score=np.full(len(snr_db), 0.9),
            path_class=labels.path_class.astype(np.uint8),
            covariance=polar_covariance(
                snr_db, np.zeros(len(snr_db), bool), RangeAzimuthGrid().range_bin_m, PeakParams()
            ),
            peak_stamp_ns=np.zeros(len(snr_db), np.int64),
            snr_db=snr_db,
            sensitivity_db=sensitivity_db(RadarSetup()),
        )
