"""Scores of tracks over drives, against values worked out by hand."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from lab.measures.drive_metrics import DriveReport, drive_report
from lab.measures.frame_scores import bootstrap_weights
from lab.measures.object_metrics import ObjectScores
from lab.measures.object_rows import HiddenRow, ImageTruth, ScanRow, TrackRow

SCAN_S = 0.3


def hidden(
    track: int | None = None, off_mps: float = 0.5, snr_db: float | None = 30.0, single: float = 30.0
) -> HiddenRow:
    """Object 5, with the track that stands on it."""
    return HiddenRow(
        object_class="car",
        image=ImageTruth(direct=False, mirrored=snr_db is not None, snr_db=snr_db, single_snr_db=single),
        at_m=(0.0, 0.0),
        error_m=None,
        centre_m=None,
        found_by_centre=False,
        object_id=5,
        track_id=track,
        velocity_error_mps=None if track is None else off_mps,
    )


def scan(number: int, rows: list[HiddenRow], tracks: tuple[TrackRow, ...] = (), in_sight: tuple[int, ...] = (),
         place: int = 0) -> ScanRow:  # fmt: skip
    stamp_ns = 10**9 + round(number * SCAN_S * 1e9)
    return ScanRow(
        place=place, scan=number, hidden=rows, reports=[], stamp_ns=stamp_ns, in_sight=list(in_sight),
        tracks=list(tracks),
    )  # fmt: skip


def measured(scans: list[ScanRow]) -> DriveReport:
    scores = ObjectScores(scans)
    return drive_report(scores, bootstrap_weights(len(scores.places), 20, 0))


def test_an_object_is_asked_for_from_1_s_in_view_on() -> None:
    """In view from scan 0; 1.2 s later, scan 4, is the first at which a second has gone by. A track from scan 5 on."""
    report = measured([scan(number, [hidden(7 if number >= 5 else None)]) for number in range(8)])
    assert (report.recall_after_1_s.part, report.recall_after_1_s.whole) == (3.0, 4.0)
    assert report.recall_25_db_after_1_s == report.recall_after_1_s
    assert report.minutes == pytest.approx(8 * SCAN_S / 60.0)


def test_a_gap_in_view_begins_the_second_again() -> None:
    rows = [hidden(7, snr_db=None if number == 3 else 30.0) for number in range(9)]
    report = measured([scan(number, [row]) for number, row in enumerate(rows)])
    # scans 4 to 8 are 1.2 s
    assert report.recall_after_1_s.whole == 1.0
    weak = measured([scan(number, [hidden(7, single=20.0 if number == 4 else 30.0)]) for number in range(9)])
    assert (weak.recall_after_1_s.whole, weak.recall_25_db_after_1_s.whole) == (5.0, 0.0)


def test_tracks_count_by_where_they_are_in_most_scans() -> None:
    """Track 1 on nothing twice of three; 2 on a car in sight; 3 near the hidden one; 4 has nothing out of sight."""
    nothing, near = (
        TrackRow(id=1, at_m=(0.0, 0.0), error_m=9.0, box_m=9.0),
        TrackRow(id=1, at_m=(0.0, 0.0), error_m=0.5, box_m=0.0),
    )
    others = (
        TrackRow(id=2, at_m=(0.0, 0.0), error_m=9.0, box_m=0.5),
        TrackRow(id=3, at_m=(0.0, 0.0), error_m=1.5, box_m=1.0),
        TrackRow(id=4, at_m=(0.0, 0.0), error_m=None, box_m=None),
    )
    scans = [scan(0, [hidden()], (near, *others)), *(scan(number, [hidden()], (nothing, *others)) for number in (1, 2))]
    report = measured(scans)
    minutes = 3 * SCAN_S / 60.0
    assert (report.false_tracks_per_minute.part, report.false_tracks_per_minute.whole) == (2.0, pytest.approx(minutes))
    assert report.in_sight_tracks_per_minute.part == 1.0


def test_id_switches_and_velocity_errors() -> None:
    """Ids 7, 7, none, 8, 8, 8: one switch; the first error is 3 m/s, from 1 s later on (scans 4 and 5) 1 m/s."""
    ids = (7, 7, None, 8, 8, 8)
    report = measured([scan(n, [hidden(track, off_mps=3.0 if n < 4 else 1.0)]) for n, track in enumerate(ids)])
    assert (report.id_switches.part, report.id_switches.whole) == (1.0, 1.0)
    assert report.first_velocity_error_mps["p50"].value == 3.0
    assert report.later_velocity_error_mps["p90"].value == 1.0


def test_class_changes_are_those_of_one_track() -> None:
    """Car, car, van by track 7, van by track 8, car by 8: of three pairs of scans with one track two change."""
    said = ((7, "car"), (7, "car"), (7, "van"), (8, "van"), (8, "car"))
    rows = [msgspec.structs.replace(hidden(track), track_class=kind) for track, kind in said]
    report = measured([scan(n, [row]) for n, row in enumerate(rows)])
    assert (report.class_changes.part, report.class_changes.whole) == (2.0, 3.0)


def test_lead_is_the_time_before_direct_sight_of_what_a_mirror_allows() -> None:
    """First shown at scan 1 (12 dB), a track from scan 3 on, in direct sight at scan 6."""
    rows = [hidden(7 if n >= 3 else None, snr_db=12.0 if n >= 1 else 5.0) for n in range(6)]
    scans = [*(scan(n, [row]) for n, row in enumerate(rows)), scan(6, [], in_sight=(5,))]
    report = measured(scans)
    assert (report.lead.part, report.lead.whole) == (pytest.approx(3 * SCAN_S), pytest.approx(5 * SCAN_S))
    # that never comes into sight is not asked
    assert measured(scans[:6]).lead.whole == 0.0
    # in sight before it was ever hidden does not count
    assert measured([scan(0, [], in_sight=(5,)), *(scan(n + 1, [row]) for n, row in enumerate(rows))]).lead.whole == 0.0


def test_drives_are_the_units() -> None:
    """Two drives, of which one is followed: the interval spans both."""
    scans = [scan(n, [hidden(7 if place else None)], place=place) for place in range(2) for n in range(6)]
    report = measured(scans)
    assert (report.drives, report.recall_after_1_s.value) == (2, 0.5)
    assert (report.recall_after_1_s.low, report.recall_after_1_s.high) == (0.0, 1.0)


def test_a_drive_without_objects_and_no_drive_at_all() -> None:
    empty = measured([scan(0, []), scan(1, [])])
    assert empty.recall_after_1_s.value is None
    assert empty.first_velocity_error_mps == {}
    with pytest.raises(ValueError, match="weights must have shape"):
        drive_report(ObjectScores([]), np.ones((1, 1)))
