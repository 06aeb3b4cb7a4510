"""Rows of scans: what was out of sight, what was reported and followed, and how far off each of them is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from scipy.optimize import linear_sum_assignment

from models.scores.object_error import as_object, object_distances
from models.scores.object_matching import assign_within
from msgs.values.perception import HiddenObject, SceneTruth, Track, TruthObject

#: Maximum position error of a found object.
FOUND_M = 1.0
#: A report further than this from every object out of sight is false; one further than that from the box of every
#: object, in sight or out of it, has no object near.
FALSE_M, NOTHING_M = 2.0, 2.5
#: Edges of the bands of image SNR, dB.
BAND_EDGES_DB = (15.0, 25.0, 40.0)
BANDS = ("no image", "< 15 dB", "15-25 dB", "25-40 dB", "> 40 dB")


class ImageTruth(msgspec.Struct, frozen=True, kw_only=True):
    """Visibility of one object before any detection; SNR None: no image lies in the map."""

    direct: bool
    #: Some mirror shows a part of it, wherever the image lies.
    mirrored: bool
    snr_db: float | None
    #: Of images by one mirror.
    single_snr_db: float | None


class HiddenRow(msgspec.Struct, frozen=True, kw_only=True):
    """One object out of direct sight and its result."""

    object_class: str
    image: ImageTruth
    #: Its centre.
    at_m: tuple[float, float]
    #: Of the report that found it, None without one: position error, distance of centres.
    error_m: float | None
    centre_m: float | None
    #: Found one to one if the distance of centres alone counts.
    found_by_centre: bool
    #: Class of that report, and of the track.
    reported_class: str | None = None
    track_class: str | None = None
    #: Highest threshold of the score at which it is found: reports by falling score each take the nearest object left.
    score: float | None = None
    #: Squared Mahalanobis distance of the truth by the covariance of the report that found it.
    mahalanobis2: float | None = None
    object_id: int = -1
    #: Of the confirmed track that stands on it, one to one: its id, and how far off its velocity is.
    track_id: int | None = None
    velocity_error_mps: float | None = None
    #: The view calls the cell in which it stands observable by a mirror.
    promised: bool = False


class TrackRow(msgspec.Struct, frozen=True, kw_only=True):
    """One confirmed track in a scan: as `ReportRow`."""

    id: int
    at_m: tuple[float, float]
    error_m: float | None
    box_m: float | None


class GospaRow(msgspec.Struct, frozen=True, kw_only=True):
    """Parts of the generalised optimal sub-pattern assignment of a scan's confirmed tracks and hidden objects."""

    #: Sum of the squared errors of the pairs nearer than the cut-off, `FALSE_M`.
    pairs_m2: float
    missed: int
    false: int

    @property
    def distance_m(self) -> float:
        """The metric, of order 2 and with alpha = 2 (Rahmathullah et al. 2017)."""
        return math.sqrt(self.pairs_m2 + 0.5 * FALSE_M**2 * (self.missed + self.false))


class ReportRow(msgspec.Struct, frozen=True, kw_only=True):
    """One reported object."""

    score: float
    #: Whether it found a hidden object; and whether it would within `FALSE_M`, one to one as well.
    found: bool
    found_wide: bool = False
    #: Position error, and distance of centres, to the nearest object out of sight; None: there is none.
    error_m: float | None
    centre_m: float | None
    #: Distance to the nearest box of any object; None: there is none.
    box_m: float | None


class ScanRow(msgspec.Struct, frozen=True, kw_only=True):
    """One scan of a place."""

    place: int
    scan: int
    hidden: list[HiddenRow]
    reports: list[ReportRow]
    stamp_ns: int = 0
    #: Objects in direct sight.
    in_sight: list[int] = []
    tracks: list[TrackRow] = []
    gospa: GospaRow = GospaRow(pairs_m2=0.0, missed=0, false=0)


def scan_row(
    place: int,
    objects: Sequence[HiddenObject],
    truth: SceneTruth,
    images: Sequence[ImageTruth],
    tracks: Sequence[Track] = (),
    promised: Sequence[bool] | None = None,
) -> ScanRow:
    """Reduce a scan's reports, tracks and truth to a row; `images` are those of `truth.objects`, in order, and so is
    whether the view calls each one's place observable by a mirror.

    Objects that no mirror shows are listed too: they are not to be found, but a report there is not false.
    """
    out_of_sight = [index for index, image in enumerate(images) if not image.direct]
    distances = object_distances(objects, truth, truth.objects)
    error_m, centre_m = distances.error_m[:, out_of_sight], distances.centre_m[:, out_of_sight]
    mahalanobis2 = distances.mahalanobis2[:, out_of_sight]
    mirrored = np.array([images[index].mirrored for index in out_of_sight], bool)
    by = {int(column): int(row) for row, column in _matched(error_m, mirrored)}
    scores = _first_scores([report.score for report in objects], error_m, mirrored)
    wide = {int(row) for row, _ in _matched(error_m, mirrored, FALSE_M)}
    by_centre = {int(column) for _, column in _matched(centre_m, mirrored)}
    track_error_m, track_box_m = _track_distances_m(tracks, truth, out_of_sight)
    followed = {int(column): tracks[int(row)] for row, column in _matched(track_error_m, mirrored)}
    hidden = [
        HiddenRow(
            object_class=truth.objects[index].object_class,
            image=images[index],
            at_m=(truth.objects[index].x_m, truth.objects[index].y_m),
            error_m=float(error_m[by[column], column]) if column in by else None,
            centre_m=float(centre_m[by[column], column]) if column in by else None,
            found_by_centre=column in by_centre,
            score=scores.get(column),
            reported_class=objects[by[column]].object_class if column in by else None,
            mahalanobis2=float(mahalanobis2[by[column], column]) if column in by else None,
            object_id=truth.objects[index].id,
            promised=promised is not None and promised[index],
            **_track_of(followed.get(column), truth.objects[index]),
        )
        for column, index in enumerate(out_of_sight)
    ]
    reports = [
        ReportRow(
            score=report.score,
            found=row in by.values(),
            found_wide=row in wide,
            error_m=_least(error_m[row]),
            centre_m=_least(centre_m[row]),
            box_m=_least(distances.box_m[row]),
        )
        for row, report in enumerate(objects)
    ]
    return ScanRow(
        place=place,
        scan=truth.scan_id,
        hidden=hidden,
        reports=reports,
        stamp_ns=truth.stamp_ns,
        in_sight=[item.id for item, image in zip(truth.objects, images, strict=True) if image.direct],
        tracks=[
            TrackRow(
                id=track.id,
                at_m=(track.x_m, track.y_m),
                error_m=_least(track_error_m[row]),
                box_m=_least(track_box_m[row]),
            )
            for row, track in enumerate(tracks)
        ],
        gospa=_gospa(track_error_m[:, mirrored]),
    )


def _track_distances_m(
    tracks: Sequence[Track], truth: SceneTruth, out_of_sight: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return position errors to the objects out of sight and distances to the boxes of all, by track."""
    distances = object_distances([as_object(track) for track in tracks], truth, truth.objects)
    return distances.error_m[:, out_of_sight], distances.box_m


def _track_of(track: Track | None, truth: TruthObject) -> dict[str, Any]:
    """Return what a row says of the track that stands on an object."""
    if track is None:
        return {}
    off_mps = math.hypot(track.velocity_x_mps - truth.velocity_x_mps, track.velocity_y_mps - truth.velocity_y_mps)
    return {"track_id": track.id, "velocity_error_mps": off_mps, "track_class": track.object_class}


def _gospa(error_m: np.ndarray) -> GospaRow:
    """Return the parts for errors [tracks, objects that a mirror shows]."""
    squared_m2 = np.minimum(error_m, FALSE_M) ** 2
    rows, columns = linear_sum_assignment(squared_m2)
    paired_m2 = squared_m2[rows, columns][error_m[rows, columns] < FALSE_M]
    tracks, objects = error_m.shape
    return GospaRow(pairs_m2=float(paired_m2.sum()), missed=objects - len(paired_m2), false=tracks - len(paired_m2))


def _matched(distance_m: np.ndarray, mirrored: np.ndarray, gate_m: float = FOUND_M) -> np.ndarray:
    """Return pairs (report, object) within a gate, one to one, of the objects [N] that a mirror shows."""
    pairs = assign_within(distance_m[:, mirrored], gate_m)
    return np.stack([pairs[:, 0], np.flatnonzero(mirrored)[pairs[:, 1]]], axis=1)


def _first_scores(scores: Sequence[float], error_m: np.ndarray, mirrored: np.ndarray) -> dict[int, float]:
    """Return the score of the first report, by falling score, that finds each object that a mirror shows."""
    left_m = np.where(mirrored, error_m, np.inf)
    first: dict[int, float] = {}
    for row in np.argsort(-np.asarray(scores, np.float64), kind="stable") if left_m.size else ():
        column = int(left_m[row].argmin())
        if left_m[row, column] <= FOUND_M:
            first[column] = scores[row]
            left_m[:, column] = np.inf
    return first


def _least(values: np.ndarray) -> float | None:
    return float(values.min()) if len(values) else None


def band(image: ImageTruth) -> str:
    """Return the name of the SNR band of an object's strongest image; a band holds its lower edge."""
    if image.snr_db is None:
        return BANDS[0]
    return BANDS[1 + sum(image.snr_db >= edge for edge in BAND_EDGES_DB)]


def single_reaches(row: HiddenRow, snr_db: float) -> bool:
    """Return whether one mirror alone shows an object at so much."""
    return row.image.single_snr_db is not None and row.image.single_snr_db >= snr_db


def is_false(report: ReportRow | TrackRow) -> bool:
    """Return whether a report lies further than `FALSE_M` from every object out of sight."""
    return report.error_m is None or report.error_m > FALSE_M


def is_nothing(report: ReportRow | TrackRow) -> bool:
    """Return whether a report lies further than `NOTHING_M` from every object whatever."""
    return report.box_m is None or report.box_m > NOTHING_M
