"""Quality of tracks of hidden objects over drives: what stands on an object, how early, how truly, and on nothing.

A track stands on an object as a report does (`lab.measures.object_rows`): one to one, within `FOUND_M` of a
visible face or the centre. Drives are places of several scans, the units of bootstrap draws.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby, pairwise

import msgspec
import numpy as np

from lab.measures.frame_scores import Estimate
from lab.measures.object_metrics import Draws, ObjectScores, Ratio
from lab.measures.object_rows import (
    BAND_EDGES_DB,
    FALSE_M,
    GospaRow,
    HiddenRow,
    ScanRow,
    TrackRow,
    is_false,
    is_nothing,
    single_reaches,
)
from lab.measures.tracking_scores import TrackingScores, tracking_scores
from msgs.values.units import s_from_ns

#: So long an object has been in view before it is asked for.
IN_VIEW_S = 1.0
#: Stamps of scans may be so far off their period.
SLACK_S = 0.01
#: The most possible lead begins where a mirror shows an object by this much.
VISIBLE_SNR_DB = 10.0


class DriveReport(msgspec.Struct, frozen=True, kw_only=True):
    """All measures of one profile over drives."""

    drives: int
    minutes: float
    #: Of objects out of sight that mirrors have shown without a gap for 1 s, scan by scan: those that a confirmed track
    #: stands on; and of those among them that one mirror alone has shown at 25 dB or more for as long.
    recall_after_1_s: Ratio
    recall_25_db_after_1_s: Ratio
    #: Confirmed tracks that in most of their scans stand on nothing, and those that do on something in plain sight.
    false_tracks_per_minute: Ratio
    in_sight_tracks_per_minute: Ratio
    #: Changes of the id on an object, of the objects that a track stood on.
    id_switches: Ratio
    #: Changes of the class that a track says of an object, of the scans in which it stood there in the scan before.
    class_changes: Ratio
    #: Mean of the GOSPA of the scans [m], cut off at 2 m, and its squared parts a scan [m2].
    gospa_m: Ratio
    gospa_pairs_m2: Ratio
    gospa_missed_m2: Ratio
    gospa_false_m2: Ratio
    #: MOTA, IDF1 and HOTA of confirmed tracks by the distance of centres.
    standard: TrackingScores
    #: Quantiles [m/s]: at the first scan of a track that stands on an object, and from 1 s later on.
    first_velocity_error_mps: dict[str, Estimate]
    later_velocity_error_mps: dict[str, Estimate]
    #: Of objects that come into direct sight: time from the first track on them to then, of the time from the first
    #: scan in which a mirror showed them.
    lead: Ratio


def drive_report(scores: ObjectScores, weights: np.ndarray) -> DriveReport:
    """Measure the tracks of one profile; `weights` [B, P] are bootstrap draws of its drives.

    Raises `ValueError` without a scan or with weights of other places.
    """
    draw = Draws(scores, weights)
    drives = [list(scans) for _, scans in groupby(scores.scans, key=lambda scan: scan.place)]
    of_drives = [_histories(scans) for scans in drives]
    minutes = np.array([_duration_s(scans) for scans in drives]) / 60.0

    def sums(value: Callable[[History], tuple[float, float]]) -> Ratio:
        parts = np.array(
            [np.sum([value(history) for history in histories] or [(0.0, 0.0)], axis=0) for histories in of_drives]
        )
        return draw.ratio(parts[:, 0], parts[:, 1])

    firsts, laters = [], []
    for row, histories in enumerate(of_drives):
        for history in histories:
            first, later = history.velocity_errors_mps()
            firsts += [(row, error) for error in first]
            laters += [(row, error) for error in later]
    stands = [_stands(scans) for scans in drives]

    def gospa(value: Callable[[GospaRow], float]) -> Ratio:
        parts = np.array([sum(value(scan.gospa) for scan in scans) for scans in drives], np.float64)
        return draw.ratio(parts, scores.scans_by_place)

    return DriveReport(
        drives=len(drives),
        minutes=float(minutes.sum()),
        recall_after_1_s=sums(lambda history: history.followed_after(lambda row: True)),
        recall_25_db_after_1_s=sums(lambda history: history.followed_after(_is_loud)),
        false_tracks_per_minute=draw.ratio(np.array([where.count("nothing") for where in stands], np.float64), minutes),
        in_sight_tracks_per_minute=draw.ratio(
            np.array([where.count("in sight") for where in stands], np.float64), minutes
        ),
        id_switches=sums(lambda history: history.id_switches()),
        class_changes=sums(lambda history: history.class_changes()),
        gospa_m=gospa(lambda row: row.distance_m),
        gospa_pairs_m2=gospa(lambda row: row.pairs_m2),
        gospa_missed_m2=gospa(lambda row: 0.5 * FALSE_M**2 * row.missed),
        gospa_false_m2=gospa(lambda row: 0.5 * FALSE_M**2 * row.false),
        standard=tracking_scores(drives, weights),
        first_velocity_error_mps=draw.quantiles(firsts),
        later_velocity_error_mps=draw.quantiles(laters),
        lead=sums(lambda history: history.lead_s()),
    )


class History(msgspec.Struct, frozen=True, kw_only=True):
    """One object over a drive: its row in each scan, None where it is not to be found, and when sight of it came."""

    times_s: list[float]
    rows: list[HiddenRow | None]
    #: Time of the first scan in direct sight after it was out of it; None: never.
    sight_s: float | None

    def followed_after(self, holds: Callable[[HiddenRow], bool]) -> tuple[float, float]:
        """Return the scans in which a track stands on it, and the scans in which one should: a condition has held for
        `IN_VIEW_S`.
        """
        followed = asked = 0.0
        since_s: float | None = None
        for time_s, row in zip(self.times_s, self.rows, strict=True):
            if row is None or not holds(row):
                since_s = None
                continue
            since_s = time_s if since_s is None else since_s
            if time_s - since_s >= IN_VIEW_S - SLACK_S:
                asked += 1.0
                followed += row.track_id is not None
        return followed, asked

    def _followed(self) -> list[tuple[float, HiddenRow]]:
        pairs = zip(self.times_s, self.rows, strict=True)
        return [(time_s, row) for time_s, row in pairs if row is not None and row.track_id is not None]

    def id_switches(self) -> tuple[float, float]:
        """Return the number of changes of the id that stands on it, and 1 if any track does."""
        ids = [row.track_id for _, row in self._followed()]
        return float(sum(before != after for before, after in pairwise(ids))), float(bool(ids))

    def class_changes(self) -> tuple[float, float]:
        """Return in how many scans the track says another class than in the scan before, and how many there are."""
        same = [
            (before, after)
            for before, after in pairwise(self.rows)
            if before and after and before.track_id is not None and before.track_id == after.track_id
        ]
        return float(sum(before.track_class != after.track_class for before, after in same)), float(len(same))

    def velocity_errors_mps(self) -> tuple[list[float], list[float]]:
        """Return velocity errors at the first scan that a track stands on it, and of the scans 1 s later and on."""
        followed = self._followed()
        if not followed:
            return [], []
        start_s = followed[0][0]
        errors = [(time_s, row.velocity_error_mps or 0.0) for time_s, row in followed]
        return [errors[0][1]], [error for time_s, error in errors if time_s - start_s >= IN_VIEW_S - SLACK_S]

    def lead_s(self) -> tuple[float, float]:
        """Return how long before direct sight a track stood on it, and how long a mirror showed it."""
        if self.sight_s is None:
            return 0.0, 0.0
        before = [(time_s, row) for time_s, row in zip(self.times_s, self.rows, strict=True) if time_s < self.sight_s]
        shown_s = [time_s for time_s, row in before if row is not None and (row.image.snr_db or 0.0) >= VISIBLE_SNR_DB]
        if not shown_s:
            return 0.0, 0.0
        followed_s = [time_s for time_s, row in before if row is not None and row.track_id is not None]
        possible_s = self.sight_s - shown_s[0]
        return (min(self.sight_s - followed_s[0], possible_s) if followed_s else 0.0), possible_s


def _is_loud(row: HiddenRow) -> bool:
    return single_reaches(row, BAND_EDGES_DB[1])


def _histories(scans: Sequence[ScanRow]) -> list[History]:
    """Return the history of every object that was out of sight at some time of a drive."""
    times_s = [s_from_ns(scan.stamp_ns - scans[0].stamp_ns) for scan in scans]
    rows = [{row.object_id: row for row in scan.hidden} for scan in scans]
    ids = sorted({object_id for by_id in rows for object_id in by_id})
    return [_history(object_id, times_s, [by_id.get(object_id) for by_id in rows], scans) for object_id in ids]


def _history(
    object_id: int, times_s: list[float], rows: Sequence[HiddenRow | None], scans: Sequence[ScanRow]
) -> History:
    first = next(index for index, row in enumerate(rows) if row is not None)
    later = zip(times_s[first:], scans[first:], strict=True)
    return History(
        times_s=times_s,
        rows=[row if row is not None and row.image.mirrored else None for row in rows],
        sight_s=next((time_s for time_s, scan in later if object_id in scan.in_sight), None),
    )


def _stands(scans: Sequence[ScanRow]) -> list[str]:
    """Return where each confirmed track of a drive stands in most of its scans."""
    stands: dict[int, list[str]] = {}
    for scan in scans:
        for track in scan.tracks:
            stands.setdefault(track.id, []).append(_stand(track))
    # of as many scans each the first
    return [max(dict.fromkeys(where), key=where.count) for where in stands.values()]


def _stand(track: TrackRow) -> str:
    if not is_false(track):
        return "hidden"
    return "nothing" if is_nothing(track) else "in sight"


def _duration_s(scans: Sequence[ScanRow]) -> float:
    """Return how long a drive lasts, its last scan included."""
    between_s = s_from_ns(scans[-1].stamp_ns - scans[0].stamp_ns)
    return between_s * len(scans) / max(len(scans) - 1, 1)
