"""MOTA, IDF1 and HOTA of tracks, against values worked out by hand.

`test_scores_of_drawn_drives_are_those_of_the_authors_code` holds figures that trackeval 1.3.0 gives, with
similarities 1 - distance / 2 m and a threshold just over zero for MOTA and IDF1.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from lab.measures.frame_scores import bootstrap_weights
from lab.measures.object_rows import HiddenRow, ImageTruth, ScanRow, TrackRow
from lab.measures.tracking_scores import TrackingScores, drive_sums, tracking_scores

Marks = dict[int, tuple[float, float]]


#: Of the drives of `drawn_drive` at seed 7.
AUTHORS = {
    "mota": 0.55,
    "idf1": 0.540084388185654,
    "hota": 0.31370242751904237,
    "deta": 0.35178299339361857,
    "assa": 0.2811195077538124,
    "loca": 0.7430398979443191,
}


def scan(number: int, objects: Marks, tracks: Marks, mirrored: bool = True) -> ScanRow:
    image = ImageTruth(direct=False, mirrored=mirrored, snr_db=None, single_snr_db=None)
    return ScanRow(
        place=0, scan=number, reports=[],
        hidden=[
            HiddenRow(object_class="car", image=image, at_m=at_m, error_m=None, centre_m=None, found_by_centre=False,
                      object_id=object_id)
            for object_id, at_m in objects.items()
        ],
        tracks=[TrackRow(id=track_id, at_m=at_m, error_m=None, box_m=None) for track_id, at_m in tracks.items()],
    )  # fmt: skip


def scored(*drives: list[ScanRow]) -> TrackingScores:
    return tracking_scores(drives, bootstrap_weights(len(drives), 20, 0))


def values(scores: TrackingScores) -> dict[str, float]:
    return {name: getattr(scores, name).value for name in scores.__struct_fields__}


def test_a_track_on_its_object_all_the_time_is_perfect() -> None:
    drive = [scan(n, {5: (float(n), 0.0)}, {1: (float(n), 0.0)}) for n in range(4)]
    assert values(scored(drive)) == dict.fromkeys(("mota", "idf1", "hota", "deta", "assa", "loca"), 1.0)


def test_one_change_of_identity_halves_association_alone() -> None:
    """Two scans by track 1, two by track 2: one change of four objects; IDF1 pairs two of four; A = 2 / (4 + 2 - 2)."""
    drive = [scan(n, {5: (0.0, 0.0)}, {1 if n < 2 else 2: (0.0, 0.0)}) for n in range(4)]
    scores = values(scored(drive))
    assert (scores["mota"], scores["idf1"], scores["deta"], scores["assa"]) == (0.75, 0.5, 1.0, 0.5)
    assert scores["hota"] == pytest.approx(math.sqrt(0.5))


def test_an_offset_of_half_the_gate_counts_at_ten_of_nineteen_levels() -> None:
    """Similarity 0.5 reaches 0.05 to 0.5; LocA is 0.5 there and 1 where nothing matches."""
    scores = values(scored([scan(n, {5: (0.0, 0.0)}, {1: (1.0, 0.0)}) for n in range(3)]))
    assert (scores["mota"], scores["idf1"]) == (1.0, 1.0)
    assert scores["hota"] == pytest.approx(10 / 19)
    assert scores["deta"] == pytest.approx(10 / 19)
    assert scores["loca"] == pytest.approx((10 * 0.5 + 9) / 19)


def test_misses_and_false_tracks() -> None:
    """Of four scans one without a track and one with a false one beside: 1 - 2/4; 2 x 3 / (4 + 4); 3 of 4 + 4 - 3."""
    tracks: list[Marks] = [{1: (0.0, 0.0)}, {}, {1: (0.0, 0.0), 9: (2.0, 0.0)}, {1: (0.0, 0.0)}]
    scores = values(scored([scan(n, {5: (0.0, 0.0)}, marks) for n, marks in enumerate(tracks)]))
    assert (scores["mota"], scores["idf1"], scores["deta"]) == (0.5, 0.75, 0.6)
    assert scores["assa"] == 0.75


def test_a_pair_stays_while_it_is_within_the_gate() -> None:
    """Track 2 comes nearer than track 1, which stays on the object: no change of identity, one false report a scan."""
    drive = [scan(n, {5: (0.0, 0.0)}, {1: (1.5, 0.0)} | ({2: (0.1, 0.0)} if n else {})) for n in range(3)]
    objects, tracks, misses, false, changes, matched = drive_sums(drive)[:6]
    assert (objects, tracks, misses, false, changes, matched) == (3, 5, 0, 2, 0, 3)


def test_objects_that_no_mirror_shows_are_not_asked_for() -> None:
    scores = scored([scan(0, {5: (0.0, 0.0)}, {}, mirrored=False)])
    assert all(math.isnan(value) for name, value in values(scores).items() if name not in ("assa", "loca"))


def test_sums_of_drives_add_and_ids_of_two_drives_are_not_the_same() -> None:
    good = [scan(n, {5: (0.0, 0.0)}, {1: (0.0, 0.0)}) for n in range(2)]
    missed = [scan(n, {5: (0.0, 0.0)}, {}) for n in range(2)]
    scores = scored(good, missed)
    assert scores.mota.value == 0.5
    assert (scores.mota.low, scores.mota.high) == (0.0, 1.0)
    assert scores.assa.value == 1.0
    assert scored(good, good).idf1.value == 1.0


def drawn_drive(rng: np.random.Generator) -> list[ScanRow]:
    """Three objects in motion; tracks that miss, change their id and stand on nothing."""
    at_m, step_m, ids = rng.uniform(0.0, 6.0, (3, 2)), rng.normal(0.0, 0.2, (3, 2)), [0, 1, 2]
    scans = []
    for number in range(20):
        at_m = at_m + step_m
        if rng.random() < 0.2:
            ids[rng.integers(3)] = 10 + number
        tracks = {key: at + rng.normal(0.0, 0.7, 2) for key, at in zip(ids, at_m, strict=True) if rng.random() < 0.8}
        tracks |= {99: rng.uniform(0.0, 6.0, 2)} if rng.random() < 0.4 else {}
        marks = {key: (float(x_m), float(y_m)) for key, (x_m, y_m) in tracks.items()}
        scans.append(scan(number, {n: (float(x_m), float(y_m)) for n, (x_m, y_m) in enumerate(at_m)}, marks))
    return scans


def test_scores_of_drawn_drives_are_those_of_the_authors_code() -> None:
    rng = np.random.default_rng(7)
    scores = values(scored(drawn_drive(rng), drawn_drive(rng)))
    assert scores == pytest.approx(AUTHORS, abs=1e-12)
