"""Leads, errors and sums of `benchmarks.accuracy.random_side_streets` by hand, and runs that are stopped or shared
out."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from benchmarks.accuracy import random_side_streets
from benchmarks.accuracy.random_side_streets import (
    DriveResult,
    Observed,
    Report,
    Settings,
    Tracked,
    draw_figure,
    hidden_truth,
    lines_of,
    results_of,
    states_of,
    summary_of,
)
from msgs.values.perception import SceneTruth, Track, TruthObject
from sim_player.drive import Drive

NONE = np.zeros((0, 3), np.float32)
#: The crossing car, 4.5 m by 1.8 m along x, goes 3 m/s along -y; another stands in plain sight.
CAR = TruthObject(
    id=0, object_class="car", x_m=20.0, y_m=10.0, length_m=4.5, width_m=1.8, yaw_rad=0.0, velocity_y_mps=-3.0
)
SEEN = TruthObject(id=1, object_class="car", x_m=10.0, y_m=-4.0, length_m=4.5, width_m=1.8, yaw_rad=0.0)
TRUTH = hidden_truth(
    SceneTruth(
        stamp_ns=0, scan_id=0, los_points_m=NONE, mirrored_points_m=NONE, hidden_points_m=NONE,
        hidden_object=np.zeros(0, np.int32), objects=(CAR, SEEN),
    ),
    frozenset({1}),
)  # fmt: skip


def track(number: int, x_m: float, y_m: float, velocity_y_mps: float = 0.0) -> Track:
    return Track(
        id=number, x_m=x_m, y_m=y_m, velocity_x_mps=0.0, velocity_y_mps=velocity_y_mps, age_s=1.0,
        cov_m2=((1.0, 0.0), (0.0, 1.0)),
    )  # fmt: skip


def observed(*scans: tuple[Track, ...]) -> Observed:
    """One way's tracks in scans 0.3 s apart."""
    made = Observed()
    for number, tracks in enumerate(scans):
        made.add(tracks, TRUTH, 0.3 * number)
    return made


def test_a_track_that_stays_leads_from_its_first_scan() -> None:
    """Scans at 0, 0.3, 0.6 ... 1.5 s, sight at 1.8 s; tracked from 0.3 s on, 1 m off the centre, 1 m/s too slow."""
    mine = (track(7, 21.0, 10.0, velocity_y_mps=-2.0),)
    tracked = observed((), mine, mine, mine, mine, mine).summary(1.8)
    assert (tracked.lead_s, tracked.kept_lead_s) == (pytest.approx(1.5), pytest.approx(1.5))
    assert tracked.first is not None
    assert tracked.later is not None
    assert (tracked.first.time_s, tracked.later.time_s) == (pytest.approx(0.3), pytest.approx(1.5))
    assert (tracked.first.face_error_m, tracked.first.centre_error_m) == (pytest.approx(1.0), pytest.approx(1.0))
    assert tracked.first.velocity_error_mps == pytest.approx(1.0)
    assert (tracked.id_switches, tracked.false_tracks, tracked.plain_sight_tracks) == (0, 0, 0)


def test_another_id_and_a_gap_cost_the_kept_lead() -> None:
    one, other = (track(7, 21.0, 10.0),), (track(8, 21.0, 10.0),)
    tracked = observed(one, one, other, other).summary(1.2)
    assert (tracked.lead_s, tracked.kept_lead_s) == (pytest.approx(1.2), pytest.approx(0.6))
    assert tracked.id_switches == 1
    lost = observed(one, one, one, ()).summary(1.2)
    assert (lost.lead_s, lost.kept_lead_s) == (pytest.approx(1.2), 0.0)


def test_a_track_beyond_two_metres_is_no_find() -> None:
    tracked = observed((track(7, 22.1, 10.0),)).summary(0.3)
    assert tracked.first is None
    assert (tracked.lead_s, tracked.kept_lead_s, tracked.sight_before_later) == (0.0, 0.0, False)


def test_a_later_error_needs_a_second() -> None:
    mine = (track(7, 21.0, 10.0),)
    early = observed(mine, mine, mine).summary(0.9)
    assert (early.later, early.sight_before_later) == (None, True)
    gone = observed(mine, mine, mine, mine, (), ()).summary(1.8)
    assert (gone.later, gone.sight_before_later) == (None, False)


def test_tracks_of_nothing_and_of_plain_sight_are_told_apart() -> None:
    """3 m off every outline: nothing; 1.5 m before the front of the car in sight: that; both by most of their scans."""
    nothing, plain = track(3, 20.0, 14.0), track(4, 13.75, -4.0)
    wanders = track(3, 20.0, 10.5)
    tracked = observed((nothing, plain), (nothing, plain), (wanders, plain)).summary(0.9)
    assert (tracked.false_tracks, tracked.plain_sight_tracks) == (1, 1)


def result(index: int, possible_s: float, lead_s: float, kept_s: float, false: int = 0) -> DriveResult:
    """A drive of 3 s to direct sight."""
    report = Report(time_s=3.0 - lead_s, face_error_m=0.4, centre_error_m=1.2, velocity_error_mps=0.5)
    tracked = Tracked(
        first=report if lead_s else None, later=None, sight_before_later=0.0 < lead_s < 1.0, lead_s=lead_s,
        kept_lead_s=kept_s, id_switches=index, false_tracks=false, plain_sight_tracks=0,
    )  # fmt: skip
    return DriveResult(
        index=index, layout="bend", manner="steady", object_class="car", object_speed_mps=5.0, ego_speed_mps=8.0,
        sight_s=3.0, image_scans=4, most_possible_s=possible_s, ways={"way": tracked},
    )  # fmt: skip


RESULTS = [
    result(0, 2.0, 1.0, 1.0),
    result(1, 1.0, 0.0, 0.0, false=2),
    result(2, 0.0, 0.6, 0.0),
    result(3, 1.0, 0.4, 0.4),
]


def test_no_drive_is_left_out_of_the_sums() -> None:
    """Of 4 drives of 3 s: leads 1, 0, 0.6, 0.4 s, of which 1, 0, 0, 0.4 s count towards the 4 s that were possible."""
    summary = summary_of("way", RESULTS, seed=0)
    assert (summary.drives, summary.possible) == (4, 3)
    assert summary.found.value == pytest.approx(0.75)
    assert summary.kept.value == pytest.approx(0.5)
    assert summary.lead_mean_s.value == pytest.approx(0.5)
    assert summary.kept_lead_mean_s.value == pytest.approx(0.35)
    assert summary.most_possible_mean_s.value == pytest.approx(1.0)
    assert summary.share_of_possible.value == pytest.approx(1.4 / 4.0)
    assert summary.kept_share_of_possible.value == pytest.approx(1.4 / 4.0)
    # 2 in 12 s
    assert summary.false_tracks_per_min.value == pytest.approx(10.0)
    assert summary.id_switches == 6
    assert (summary.first_count, summary.later_count, summary.lost_later, summary.sight_before_later) == (3, 0, 1, 2)
    assert summary.first["centre_error_m"] == (pytest.approx(1.2), pytest.approx(1.2))
    assert summary.layouts == {"bend": (4, pytest.approx(1.0), pytest.approx(0.35))}
    assert summary.found.low < 0.75 < summary.found.high
    assert any("face 0.40" in line and "centre 1.20" in line for line in lines_of(summary))


def test_what_confirmation_leaves_is_told_beside_the_share() -> None:
    """The second scan of an image that shows from the start is 0.3 s on: 1.7, 0.7, 0, 0.7 s are left of 2, 1, 0, 1."""
    assert summary_of("way", RESULTS, seed=0).confirmable_mean_s.value == pytest.approx(3.1 / 4.0)


def test_the_figure_shows_every_drive(tmp_path: Path) -> None:
    path = tmp_path / "drives.png"
    draw_figure(RESULTS, path)
    assert path.stat().st_size > 10_000


def test_states_rest_before_the_drive_and_have_one_bias() -> None:
    drive = Drive(np.array([0.0, 2.0]), np.array([5.0, 5.0]), np.zeros(2))
    states = states_of(drive, [1, 2])
    rest = [state for state in states if state.stamp_ns < random_side_streets.START_NS]
    assert len(rest) == 150
    assert {state.speed_mps for state in rest} == {0.0}
    driven = np.array([state.speed_mps for state in states[150:]])
    assert abs(driven.mean() - 5.0) < 0.02
    rates = np.array([state.yaw_rate_rps for state in states])
    assert abs(rates[:150].mean() - rates[150:].mean()) < np.radians(0.1)
    assert abs(rates.mean()) <= np.radians(1.1)


#: One cheap way, two chirps a beam, basic effects: what is asked here is the machinery.
SMALL = Settings(
    seed=5, chirps=2, effects="basic", ways={"cfar": {"dense_predictor": {"method": "cfar"}, "geometry": {}}}
)


@pytest.mark.slow
def test_a_run_goes_on_where_it_was_stopped_and_workers_change_nothing(tmp_path: Path) -> None:
    out = tmp_path / "drives.jsonl"
    whole = results_of(SMALL, 2, 2, out)
    assert [one.index for one in whole] == [0, 1]
    lines = out.read_bytes().splitlines(keepends=True)
    assert len(lines) == 3
    # stopped within the second drive's line: that drive is made again, by this process
    cut = tmp_path / "cut.jsonl"
    cut.write_bytes(lines[0] + next(line for line in lines[1:] if b'"index":0,' in line) + b'{"index":1,')
    assert results_of(SMALL, 2, 1, cut) == whole
    assert sorted(cut.read_bytes().splitlines()) == sorted(out.read_bytes().splitlines())
    with pytest.raises(ValueError, match="other settings"):
        results_of(msgspec.structs.replace(SMALL, seed=6), 2, 1, out)
