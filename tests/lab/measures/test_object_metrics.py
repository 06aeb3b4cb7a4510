"""Scores object by object, against values worked out by hand."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from lab.measures.frame_scores import bootstrap_weights
from lab.measures.object_metrics import (
    ObjectScores,
    mean_loss,
    object_differences,
    object_estimates,
    object_measures,
    object_report,
)
from lab.measures.object_rows import HiddenRow, ImageTruth, ReportRow, ScanRow, band, is_false, is_nothing, scan_row
from models.scores.object_error import object_distances
from models.scores.object_matching import match_objects
from msgs.values.perception import HiddenObject, SceneTruth, Track, TruthObject
from tests.builders import example_object, example_truth

SHOWN = ImageTruth(direct=False, mirrored=True, snr_db=30.0, single_snr_db=30.0)
IN_SIGHT = ImageTruth(direct=True, mirrored=True, snr_db=30.0, single_snr_db=None)
NEVER_SHOWN = ImageTruth(direct=False, mirrored=False, snr_db=None, single_snr_db=None)


def report(x: float, y: float, score: float = 0.95, stamp_ns: int = 0) -> HiddenObject:
    return example_object(x_m=x, y_m=y, length_m=2.0, width_m=1.0, score=score, stamp_ns=stamp_ns)


def truth() -> SceneTruth:
    """Boxes 4 x 2 m along x: a car in sight at (0, -10); hidden ones at (10, 10), its face at x = 8 seen, and (20, 10)
    of which no point is over the noise; one that no mirror shows at (40, 0)."""
    points = np.array([[8.0, 9.5, 0.5], [8.0, 10.5, 0.5]], np.float32)
    at = ((0.0, -10.0), (10.0, 10.0), (20.0, 10.0), (40.0, 0.0))
    return example_truth(
        stamp_ns=10**9, scan_id=3, mirrored_points_m=points,
        hidden_points_m=points, hidden_object=np.array([1, 1], np.int32),
        objects=tuple(
            TruthObject(
                id=index, object_class="car", x_m=x, y_m=y, length_m=4.0, width_m=2.0, yaw_rad=0.0,
                velocity_x_mps=5.0 if index == 1 else 0.0, hidden=index in (1, 2),
            )
            for index, (x, y) in enumerate(at)
        ),
    )  # fmt: skip


IMAGES = (IN_SIGHT, SHOWN, SHOWN, NEVER_SHOWN)


def test_distances_are_to_face_or_centre_to_the_centre_and_to_the_box() -> None:
    """From (7.4, 10): 0.6 m to the face at x = 8 and to the box, 2.6 m to the centre of (10, 10)."""
    found = object_distances([report(7.4, 10.0)], truth(), truth().objects[:2])
    np.testing.assert_allclose(found.error_m[0], [np.hypot(7.4, 20.0), 0.6])
    np.testing.assert_allclose(found.centre_m[0], [np.hypot(7.4, 20.0), 2.6])
    np.testing.assert_allclose(found.box_m[0], [np.hypot(5.4, 19.0), 0.6])
    # half a second later the car is 2.5 m further along x, and so are its faces
    late = object_distances([report(9.9, 10.0, stamp_ns=1_500_000_000)], truth(), truth().objects[1:2])
    np.testing.assert_allclose([late.error_m[0, 0], late.centre_m[0, 0], late.box_m[0, 0]], [0.6, 2.6, 0.6])
    assert match_objects([report(7.4, 10.0)], truth()).centre_m == (pytest.approx(2.6),)


def test_the_centre_error_is_that_of_the_box() -> None:
    """A position on the face, 2.6 m from the car's centre, with a box 0.5 m from it."""
    placed = msgspec.structs.replace(report(7.4, 10.0), centre_m=(10.3, 10.4))
    found = object_distances([placed], truth(), truth().objects[1:2])
    np.testing.assert_allclose([found.error_m[0, 0], found.centre_m[0, 0]], [0.6, 0.5])


def test_a_scan_becomes_a_row_of_its_hidden_objects_and_its_reports() -> None:
    """One report at a visible face, a second on the same car, one in plain sight, one at what no mirror shows."""
    objects = [report(7.4, 10.0), report(10.1, 10.0), report(0.0, -9.0), report(40.0, 1.5), report(60.0, 60.0)]
    row = scan_row(5, objects, truth(), IMAGES)
    assert (row.place, row.scan) == (5, 3)
    assert [one.image for one in row.hidden] == [SHOWN, SHOWN, NEVER_SHOWN]
    # one to one, then the nearest: 0.1 m from the centre beats 0.6 m from the face
    assert (row.hidden[0].error_m, row.hidden[0].centre_m) == (pytest.approx(0.1), pytest.approx(0.1))
    assert row.hidden[0].found_by_centre
    assert (row.hidden[0].score, row.hidden[0].reported_class) == (objects[0].score, objects[1].object_class)
    assert [one.error_m for one in row.hidden[1:]] == [None, None]
    assert [one.found for one in row.reports] == [False, True, False, False, False]
    # the report at (40, 1.5) is 1.5 m from the centre of what no mirror shows: not false, and not a find
    assert [is_false(one) for one in row.reports] == [False, False, True, False, True]
    assert [is_nothing(one) for one in row.reports] == [False, False, False, False, True]
    assert row.reports[2].box_m == pytest.approx(0.0)
    assert row.reports[3].error_m == pytest.approx(1.5)


def test_a_face_finds_what_the_centre_does_not() -> None:
    row = scan_row(0, [report(7.4, 10.0)], truth(), IMAGES)
    assert (row.hidden[0].error_m, row.hidden[0].found_by_centre) == (pytest.approx(0.6), False)


def test_without_objects_every_report_is_nothing_and_without_reports_all_is_missed() -> None:
    empty = msgspec.structs.replace(truth(), objects=(), hidden_object=np.array([-1, -1], np.int32))
    (lonely,) = scan_row(0, [report(1.0, 1.0)], empty, ()).reports
    assert (lonely.error_m, lonely.box_m, lonely.found) == (None, None, False)
    assert is_false(lonely)
    assert is_nothing(lonely)
    silent = scan_row(0, [], truth(), IMAGES)
    assert ([one.error_m for one in silent.hidden], silent.reports) == ([None, None, None], [])


@pytest.mark.parametrize(
    ("snr_db", "name"),
    [
        (None, "no image"),
        (14.9, "< 15 dB"),
        (15.0, "15-25 dB"),
        (25.0, "25-40 dB"),
        (39.9, "25-40 dB"),
        (40.0, "> 40 dB"),
    ],
)
def test_bands_hold_their_lower_edge(snr_db: float | None, name: str) -> None:
    assert band(msgspec.structs.replace(SHOWN, snr_db=snr_db)) == name


def hidden(error_m: float | None, kind: str = "car", snr_db: float | None = 30.0, mirrored: bool = True) -> HiddenRow:
    image = ImageTruth(direct=False, mirrored=mirrored, snr_db=snr_db, single_snr_db=snr_db)
    centre_m = None if error_m is None else error_m + 1.0
    return HiddenRow(
        object_class=kind, image=image, at_m=(0.0, 0.0), error_m=error_m, centre_m=centre_m, found_by_centre=False
    )


def said(score: float, error_m: float | None, found: bool = False, box_m: float | None = 0.0) -> ReportRow:
    return ReportRow(score=score, found=found, error_m=error_m, centre_m=error_m, box_m=box_m)


def two_places() -> ObjectScores:
    """Place 0: two cars, one found, two reports of which one is false. Place 1: one pedestrian missed, one report."""
    first = ScanRow(
        place=0, scan=0, hidden=[hidden(0.4), hidden(None, snr_db=20.0), hidden(None, mirrored=False, snr_db=None)],
        reports=[said(0.95, 0.4, found=True), said(0.97, 7.0, box_m=7.0)],
    )  # fmt: skip
    second = ScanRow(
        place=1, scan=0, hidden=[hidden(None, "pedestrian", snr_db=None)], reports=[said(0.55, 1.5)]
    )  # fmt: skip
    return ObjectScores([second, first])


def test_measures_of_two_places_by_hand() -> None:
    weights = np.array([[2.0, 0.0], [0.0, 2.0], [1.0, 1.0]])
    found = object_report(two_places(), weights, false_cost=0.5)
    assert (found.scans, found.places, found.reports, found.not_mirrored) == (2, 2, 3, 1)
    assert (found.recall.part, found.recall.whole, found.recall.value) == (1.0, 3.0, pytest.approx(1.0 / 3.0))
    # the draws find 2 of 4, 0 of 2 and 1 of 3
    assert (found.recall.low, found.recall.high) == (
        pytest.approx(np.percentile([0.5, 0.0, 1.0 / 3.0], 2.5)),
        pytest.approx(np.percentile([0.5, 0.0, 1.0 / 3.0], 97.5)),
    )
    assert {name: (one.part, one.whole) for name, one in found.recall_by_class.items()} == {
        "car": (1.0, 2.0),
        "pedestrian": (0.0, 1.0),
    }
    assert {name: (one.part, one.whole) for name, one in found.recall_by_band.items()} == {
        "no image": (0.0, 1.0), "< 15 dB": (0.0, 0.0), "15-25 dB": (0.0, 1.0), "25-40 dB": (1.0, 1.0),
        "> 40 dB": (0.0, 0.0),
    }  # fmt: skip
    assert found.recall_by_band["< 15 dB"].value is None
    assert (found.recall_vehicles.whole, found.recall_single_25_db.whole) == (2.0, 1.0)
    assert (found.false.part, found.nothing.part, found.false_per_scan.value) == (1.0, 1.0, 0.5)
    assert found.precision.value == pytest.approx(1.0 / 3.0)
    # two missed and half a false report over two scans
    assert found.loss.value == pytest.approx(1.25)
    assert mean_loss({"one": found, "two": found}) == pytest.approx(1.25)
    assert found.error_found_m["p50"].value == 0.4
    assert found.centre_found_m["p50"].value == pytest.approx(1.4)
    # errors 0.4, 1.5 and 7.0 of three reports: half of them lies within 1.5 m, nine tenths within 7
    assert (found.error_ungated_m["p50"].value, found.error_ungated_m["p90"].value) == (1.5, 7.0)


def test_average_precision_by_hand() -> None:
    """Two objects of three are found by the first and third of three reports: precision 1 and 2/3 where they come."""
    reports = [said(0.7, 0.3, found=True), said(0.8, 9.0), said(0.9, 0.3, found=True)]
    scan = ScanRow(place=0, scan=0, hidden=[hidden(0.3), hidden(0.3), hidden(None)], reports=reports)
    result = object_report(ObjectScores([scan]), np.ones((1, 1)), 1.0)
    assert result.average_precision.value == pytest.approx((1.0 + 2.0 / 3.0) / 3.0)
    # drawn twice, the place is the same
    assert result.average_precision.low == pytest.approx(result.average_precision.value)
    assert result.average_precision_2_m.value == 0.0


def test_gospa_by_hand() -> None:
    """Tracks 0.6 m before the face of one car, and on nothing; the other shown car is missed: with a cut-off of 2 m."""
    tracks = [
        Track(
            id=number, x_m=x, y_m=10.0, velocity_x_mps=0.0, velocity_y_mps=0.0, age_s=1.0,
            cov_m2=((1.0, 0.0), (0.0, 1.0)),
        )
        for number, x in enumerate((7.4, 60.0))
    ]  # fmt: skip
    gospa = scan_row(0, [], truth(), IMAGES, tracks).gospa
    assert (gospa.pairs_m2, gospa.missed, gospa.false) == (pytest.approx(0.36), 1, 1)
    assert gospa.distance_m == pytest.approx(np.sqrt(0.36 + 2.0 * 2))


def test_scores_by_bin_and_their_calibration_error_by_hand() -> None:
    found = object_report(two_places(), np.ones((1, 2)), false_cost=1.0)
    high = next(one for one in found.scores if one.low == 0.9)
    assert (high.mean_score, high.found.value, high.near.value) == (pytest.approx(0.96), 0.5, 0.5)
    low = next(one for one in found.scores if one.low == 0.5)
    assert (low.mean_score, low.found.value, low.near.value) == (pytest.approx(0.55), 0.0, 1.0)
    assert sum(one.found.whole for one in found.scores) == 3.0
    assert found.calibration_error == pytest.approx((2.0 * 0.46 + 1.0 * 0.55) / 3.0)


def test_a_score_of_one_and_the_edges_belong_to_one_bin_each() -> None:
    scan = ScanRow(
        place=0, scan=0, hidden=[], reports=[said(score, None, box_m=None) for score in (0.0, 0.9, 0.99, 1.0)]
    )
    found = object_report(ObjectScores([scan]), np.ones((1, 1)), 1.0)
    assert {one.low: one.found.whole for one in found.scores if one.found.whole} == {0.0: 1.0, 0.9: 1.0, 0.99: 2.0}
    assert (found.recall.value, found.error_ungated_m, found.loss.value) == (None, {}, 4.0)


def test_an_interval_of_many_places_is_as_wide_as_the_binomial_law_says() -> None:
    """200 places with two objects, each found with probability 0.4: 2 x 1.96 sqrt(0.24 / 400) = 0.096 wide."""
    rng = np.random.default_rng(0)
    scans = [
        ScanRow(place=p, scan=0, hidden=[hidden(0.2 if rng.random() < 0.4 else None) for _ in range(2)], reports=[])
        for p in range(200)
    ]
    recall = object_report(ObjectScores(scans), bootstrap_weights(200, 500, 0), 1.0).recall
    assert recall.low is not None
    assert recall.high is not None
    assert recall.value is not None
    assert recall.low < recall.value < recall.high
    # 500 draws, and a share that is itself drawn: a few parts in ten
    assert recall.high - recall.low == pytest.approx(0.096, rel=0.2)


def test_weights_of_other_places_are_refused() -> None:
    with pytest.raises(ValueError, match=r"weights must have shape \[draws, 2\] for places, got \(1, 3\)"):
        object_report(two_places(), np.ones((1, 3)), 1.0)


def test_distances_in_standard_deviations_are_to_the_mark_that_the_covariance_calls_nearest() -> None:
    """From (7.4, 10) with 0.2 m along x and 3 m along y: the face x = 8 lies 3 sigma off, its square is 9; the centre
    (10, 10) 13. With 2 m along x: 0.3 sigma. Turned by 90 degrees about the report the same.
    """
    for (xx, yy), wanted in (((0.04, 9.0), 9.0), ((4.0, 9.0), 0.09)):
        item = msgspec.structs.replace(report(7.4, 10.0), cov_m2=((xx, 0.0), (0.0, yy)))
        assert object_distances([item], truth(), truth().objects[1:2]).mahalanobis2[0, 0] == pytest.approx(wanted)
    # no variance at all: a centimetre is believed, 0.6 m are 60 of them
    exact = msgspec.structs.replace(report(7.4, 10.0), cov_m2=((0.0, 0.0), (0.0, 0.0)))
    assert object_distances([exact], truth(), truth().objects[1:2]).mahalanobis2[0, 0] == pytest.approx(3600.0)


def test_aims_by_hand() -> None:
    """Four cars and a bicycle: at 30 dB one inside its ellipse (d2 4), one outside (d2 9), the bicycle missed; at 20 dB
    one found of two. Reports: one at nothing, one on what stands in plain sight.
    """
    rows = [
        msgspec.structs.replace(hidden(0.4), mahalanobis2=4.0),
        msgspec.structs.replace(hidden(0.4), mahalanobis2=9.0),
        hidden(None, "bicycle"),
        msgspec.structs.replace(hidden(0.4, snr_db=20.0), mahalanobis2=1.0),
        hidden(None, snr_db=20.0),
    ]
    reports = [said(0.9, 7.0, box_m=7.0), said(0.9, 7.0, box_m=0.5)]
    result = object_report(ObjectScores([ScanRow(place=0, scan=0, hidden=rows, reports=reports)]), np.ones((1, 1)), 1.0)
    shares = {
        name: (ratio.part, ratio.whole)
        for name in ("recall_single_25_db", "recall_single_15_db", "recall_vulnerable_25_db", "nothing_per_scan",
                     "in_sight_per_scan", "inside_ellipse", "nees")
        for ratio in [getattr(result, name)]
    }  # fmt: skip
    assert shares == {
        "recall_single_25_db": (2.0, 3.0), "recall_single_15_db": (1.0, 2.0), "recall_vulnerable_25_db": (0.0, 1.0),
        "nothing_per_scan": (1.0, 1.0), "in_sight_per_scan": (1.0, 1.0), "inside_ellipse": (2.0, 3.0),
        "nees": (14.0, 3.0),
    }  # fmt: skip


def test_the_threshold_at_which_an_object_is_found_ignores_fainter_reports() -> None:
    """A sure report 0.6 m from the car's face and a faint one at its centre, which is the nearest: found from 0.9 down.

    With the sure one 1.2 m away: from 0.2 down.
    """
    for x_m, score in ((7.4, 0.9), (6.8, 0.2)):
        sure, faint = (
            msgspec.structs.replace(report(at_m, 10.0), score=value) for at_m, value in ((x_m, 0.9), (10.1, 0.2))
        )
        row = scan_row(5, [faint, sure], truth(), IMAGES)
        assert (row.hidden[0].error_m, row.hidden[0].score) == (pytest.approx(0.1), score)


def test_curve_and_classes_by_hand() -> None:
    """100 scans, 4 false reports of scores 0.5 to 0.8: two a hundred scans are passed by scores over 0.6, five by all.

    Of four cars at 30 dB three are found, at 0.9, 0.65 and 0.55, one of them taken for a van; one is faint.
    """
    found = [(0.9, "car"), (0.65, "van"), (0.55, "car")]
    rows = [msgspec.structs.replace(hidden(0.4), score=score, reported_class=kind) for score, kind in found]
    rows += [hidden(None), msgspec.structs.replace(hidden(0.4, snr_db=20.0), score=0.99, reported_class="car")]
    reports = [said(score, 9.0, box_m=9.0) for score in (0.8, 0.7, 0.6, 0.5)]
    scans = [ScanRow(place=number, scan=0, hidden=[], reports=[]) for number in range(1, 100)]
    scores = ObjectScores([ScanRow(place=0, scan=0, hidden=rows, reports=reports), *scans])
    result = object_report(scores, np.ones((1, 100)), 1.0)
    assert result.recall_at_false == {"0.02": 0.5}
    assert result.classes == {"car": {"car": 3, "van": 1}}


def test_crowded_objects_have_another_out_of_sight_within_two_metres() -> None:
    """Cars at 0, 1.9 and 4 m; the last beside one that no mirror shows, which is not to be found itself."""
    rows = [
        msgspec.structs.replace(hidden(error_m, mirrored=mirrored), at_m=(x_m, 0.0))
        for x_m, error_m, mirrored in ((0.0, 0.4, True), (1.9, None, True), (4.0, 0.4, True), (5.5, None, False))
    ]
    scan = ScanRow(place=0, scan=0, hidden=rows, reports=[])
    crowded = object_report(ObjectScores([scan]), np.ones((1, 1)), 1.0).recall_crowded
    assert (crowded.part, crowded.whole) == (2.0, 3.0)
    apart = msgspec.structs.replace(scan, hidden=rows[:1])
    assert object_report(ObjectScores([apart]), np.ones((1, 1)), 1.0).recall_crowded.whole == 0.0


def test_of_what_a_view_promises_only_vehicles_count() -> None:
    """Two cars where the view says that a mirror would show a vehicle, one of them found; a pedestrian there, missed,
    and a car elsewhere, found, do not count.
    """
    rows = [
        msgspec.structs.replace(hidden(error_m, kind), promised=promised)
        for error_m, kind, promised in (
            (0.5, "car", True),
            (None, "car", True),
            (None, "pedestrian", True),
            (0.5, "car", False),
        )
    ]
    scores = ObjectScores([ScanRow(place=0, scan=0, hidden=rows, reports=[])])
    promised = object_report(scores, np.ones((1, 1)), 1.0).recall_promised
    assert (promised.part, promised.whole) == (1.0, 2.0)
    row = scan_row(0, [], truth(), IMAGES, promised=[True, False, True, False])
    assert [item.promised for item in row.hidden] == [False, True, False]


def place(index: int, *objects: HiddenObject, images: tuple[ImageTruth, ...] = IMAGES) -> ScanRow:
    return scan_row(index, objects, truth(), images)


def test_measures_of_a_comparison_are_counts_over_counts() -> None:
    """Three of four found with five reports, of which (60, 60) is false: F1 2 * 3 / (4 + 5), loss (1 + 1) / 2 scans."""
    faint = ImageTruth(direct=False, mirrored=True, snr_db=20.0, single_snr_db=20.0)
    first = place(0, report(7.4, 10.0), report(20.0, 10.0), report(60.0, 60.0))
    second = place(1, report(8.5, 10.0), report(40.0, 0.0), images=(IN_SIGHT, NEVER_SHOWN, SHOWN, faint))
    scores = ObjectScores([second, first])
    assert [len(row.reports) for row in scores.scans] == [3, 2]
    got = {name: value[0] for name, value in object_measures(scores).items()}
    # (40, 0) is found in the second place alone, where its image is faint; (8.5, 10) lies where no mirror shows a car
    assert got == pytest.approx(
        {
            "object_recall": 3 / 4,
            "object_recall_25_db": 2 / 3,
            "object_f1": 2 * 3 / (4 + 5),
            "false_objects_per_scan": 1 / 2,
            "object_loss_per_scan": (1 + 1) / 2,
        }
    )


def test_differences_of_a_comparison_are_paired() -> None:
    """One profile that finds one more in every place: a difference without any spread, unlike its two terms."""
    rows = [place(index, *[report(20.0, 10.0)] * (index % 2)) for index in range(8)]
    better = [place(index, report(7.4, 10.0), *[report(20.0, 10.0)] * (index % 2)) for index in range(8)]
    weights = bootstrap_weights(8, 200, seed=0)
    first, second = ObjectScores(better), ObjectScores(rows)
    gain = object_differences(first, second, weights)["object_recall"]
    assert (gain.value, gain.low, gain.high) == (0.5, 0.5, 0.5)
    alone = object_estimates(first, weights)["object_recall"]
    assert alone.low < alone.value < alone.high


def test_without_anything_hidden_or_said_a_measure_has_no_value() -> None:
    scores = ObjectScores([place(0, images=(IN_SIGHT, NEVER_SHOWN, NEVER_SHOWN, NEVER_SHOWN))])
    got = {name: value[0] for name, value in object_measures(scores).items()}
    assert np.isnan([got["object_recall"], got["object_recall_25_db"], got["object_f1"]]).all()
    assert (got["false_objects_per_scan"], got["object_loss_per_scan"]) == (0.0, 0.0)
