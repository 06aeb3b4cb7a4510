"""`mirrorwave view`: a recording under the same page, moved by seek, step and time."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from mirrorwave.commands.captures.view import view
from mirrorwave.replay.playback import MAX_SPEED, Playback
from mirrorwave.replay.view_log import _Marks, overview_json, read_log
from msgs.files.shipped import SAMPLE
from msgs.recording.mcap import RecordingReader, RecordingWriter
from msgs.values.camera import CameraImage
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from nodes.viewer.driver_warnings import DriverWarning, Level
from nodes.viewer.newest import SERIES, Board
from nodes.viewer.server import Play, Seek, Step
from tests.builders import example_map, example_status, example_track, example_truth, example_view
from tests.side_sensors import cloud, jpeg

SCANS = 20
PERIOD_NS = 300_000_000
START_NS = 50_000_000_000


def write_recording(path: Path, views: bool = True, set_ns: int = 0) -> Path:
    """A run of the graph: each scan's map, truth and view, the truth of odd scans a little after the view.

    From the eighth scan on with a clock that was set.
    """
    grid = RangeAzimuthGrid(range_bins=8, azimuth_bins=4)
    with RecordingWriter(path, {}) as writer:
        for scan in range(SCANS):
            at_ns = START_NS + scan * PERIOD_NS + set_ns * (scan >= 8)
            messages: list[tuple[str, Any, int]] = [
                ("vehicle/state", VehicleState(stamp_ns=at_ns, speed_mps=float(scan)), 0),
                ("diagnostics/node", example_status(stamp_ns=at_ns), 1),
                (
                    "radar/ra_map",
                    example_map(np.ones((8, 4), np.complex64), stamp_ns=at_ns, scan_id=100 + scan, grid=grid),
                    2,
                ),
                (
                    "perception/hidden_objects",
                    example_view(stamp_ns=at_ns, scan_id=100 + scan),
                    3_000_000,
                ),
                (
                    "sim/truth",
                    example_truth(stamp_ns=at_ns, scan_id=100 + scan),
                    2_000_000 + (scan % 2) * 2_000_000,
                ),
            ]  # fmt: skip
            for topic, message, later_ns in sorted(messages, key=lambda item: item[2]):
                if views or topic != "perception/hidden_objects":
                    writer.write(topic, message, publisher="graph", sequence=scan, sent_ns=at_ns + later_ns)
    return path


@pytest.fixture
def playback(tmp_path: Path) -> Iterator[Playback]:
    with RecordingReader(write_recording(tmp_path / "a.mcap")) as reader:
        yield Playback(reader, Board())


def shown(playback: Playback) -> dict[str, dict[str, Any]]:
    """What hangs on the board, as the page would read it."""
    board = playback._board
    posts = {kind: posted for kind, posted in board.newer({}).items() if kind != SERIES}
    return {kind: json.loads(board.messages(kind, posted)[0]) for kind, posted in posts.items()}


def test_it_opens_at_the_first_scan(playback: Playback) -> None:
    told = shown(playback)
    assert (playback.count, playback.index) == (SCANS, 0)
    assert told["timeline"] == {
        "type": "timeline", "index": 0, "count": SCANS, "time_s": 0.0, "duration_s": 5.7, "playing": False,
        "speed": 0.0, "loop": False, "loss": None,
    }  # fmt: skip
    assert told["view"]["scan_id"] == told["map"]["scan_id"] == 100


def test_a_scan_shows_what_the_other_sensors_saw_at_its_time(tmp_path: Path) -> None:
    """Clouds and images every 0.1 s; a view comes 0.5 s after its stamp. However a scan is reached, it is the same."""
    path = tmp_path / "rig.mcap"
    with RecordingWriter(path, {}) as writer:
        for at in range(40):
            at_ns = START_NS + at * 100_000_000
            writer.write("lidar/points", cloud(stamp_ns=at_ns), publisher="rig", sequence=at, sent_ns=at_ns)
            image = CameraImage.of(jpeg(), at_ns)
            writer.write("camera/image", image, publisher="rig", sequence=at, sent_ns=at_ns)
            if at % 3 == 0:
                view = example_view(stamp_ns=at_ns + 10, scan_id=at)
                topic, late_ns = "perception/hidden_objects", 500_000_000
                writer.write(topic, view, publisher="geometry", sequence=at, sent_ns=at_ns + late_ns)
    with RecordingReader(path) as reader:
        playback = Playback(reader, Board())
        for index in (2, 8, 2, 3):
            playback.show(index)
            told = shown(playback)
            assert told["lidar"]["stamp_s"] == told["image"]["stamp_s"] == told["view"]["stamp_s"]


def test_a_clock_that_was_set_is_no_time_on_the_timeline(playback: Playback, tmp_path: Path) -> None:
    """Not 53 years of nothing, in which the page would wait."""
    with RecordingReader(write_recording(tmp_path / "set.mcap", set_ns=17 * 10**17)) as reader:
        stepped = Playback(reader, Board())
        for item in (playback, stepped):
            item.show(7)
            item.obey([Play(1.0, False)], 0.0)
        right, over = shown(playback), shown(stepped)
    assert over["timeline"] == right["timeline"]
    assert over["overview"]["times_s"] == right["overview"]["times_s"]
    assert stepped._due_s == playback._due_s == pytest.approx(0.3)


@pytest.mark.parametrize("path", [[7], [7, 8], [19, 3], [1, 1]])
def test_however_a_scan_is_reached_it_shows_the_same(playback: Playback, path: list[int]) -> None:
    for index in path:
        playback.show(index)
    told = shown(playback)
    assert told["view"]["scan_id"] == told["map"]["scan_id"] == 100 + path[-1]
    assert told["view"]["truth"] is not None
    assert told["view"]["vehicle"]["speed_mps"] == path[-1]
    assert [row["node"] for row in told["nodes"]["nodes"]] == ["geometry"]
    assert told["timeline"]["index"] == path[-1]


def test_a_scan_outside_shows_the_nearest(playback: Playback) -> None:
    playback.obey([Seek(10**9)], 0.0)
    assert playback.index == SCANS - 1
    playback.obey([Seek(-5)], 0.0)
    assert playback.index == 0


def test_of_many_seeks_the_last_counts(playback: Playback) -> None:
    before = playback._board.newer({})["map"].version
    playback.obey([Seek(index) for index in range(19)], 0.0)
    assert playback.index == 18
    assert playback._board.newer({})["map"].version == before + 1


def test_steps_add_up_and_stop_at_the_ends(playback: Playback) -> None:
    playback.obey([Step(1), Step(1), Seek(5), Step(-2)], 0.0)
    assert playback.index == 3
    playback.obey([Step(-(10**30))], 0.0)
    assert playback.index == 0


def test_time_moves_it_at_the_speed_asked_for(playback: Playback) -> None:
    """Scans lie 0.3 s apart: at double speed the next is due after 0.15 s, and the one after at 0.3 s."""
    playback.obey([Play(2.0)], now_s=10.0)
    seen = []
    for now_s in (10.0, 10.149, 10.1501, 10.299, 10.3001):
        if now_s >= playback._due_s:
            playback._advance(now_s)
        seen.append(playback.index)
    assert seen == [0, 0, 1, 1, 2]


def test_play_ends_with_the_recording_and_starts_over(playback: Playback) -> None:
    playback.obey([Seek(SCANS - 2), Play(1.0)], now_s=0.0)
    playback._advance(1.0)
    assert playback.index == SCANS - 1
    playback._advance(2.0)
    assert not playback.playing
    playback.obey([Play(1.0)], now_s=3.0)
    assert (playback.index, playback.playing) == (0, True)


@pytest.mark.parametrize(("speed", "taken"), [(-1.0, 0.0), (1e9, MAX_SPEED), (math.inf, MAX_SPEED)])
def test_speed_is_bounded(playback: Playback, speed: float, taken: float) -> None:
    playback.obey([Play(speed)], 0.0)
    assert playback._speed == taken


def test_waiting_commands_are_obeyed_in_a_turn(playback: Playback) -> None:
    playback.commands.put(Seek(3))
    playback.commands.put(Seek(5))
    playback.turn(0.0)
    assert playback.index == 5


def test_the_command_serves_until_interrupted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(playback: Playback) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Playback, "run", interrupted)
    path = write_recording(tmp_path / "a.mcap")
    view(path, port=0, no_browser=True)
    assert f"{path}: {SCANS} scans; open http://127.0.0.1:" in capsys.readouterr().out


def test_raw_data_are_sent_to_the_verb_that_takes_them() -> None:
    with (
        RecordingReader(SAMPLE) as reader,
        pytest.raises(ValueError, match=r"of its raw data `mirrorwave process \S+ --view` makes some"),
    ):
        Playback(reader, Board())


# a drive: trails and warnings follow from all that came before


#: The vehicle rests for 9 s, in which its gyroscope shows its bias, then drives; a car follows a straight line.
REST_SCANS, DRIVE_SCANS, BIAS_RPS, SPEED_MPS = 30, 30, 0.02, 4.0
CAR_AT, CAR_VELOCITY = np.array([40.0, 30.0]), np.array([0.0, -2.0])


def small_map(scan: int, at_ns: int) -> RangeAzimuthMap:
    grid = RangeAzimuthGrid(range_bins=8, azimuth_bins=4)
    return example_map(np.full((8, 4), 1.0 + scan, np.complex64), stamp_ns=at_ns, scan_id=scan, grid=grid)


def write_drive(path: Path, tracks: bool = True) -> Path:
    """States at 20 Hz with a constant bias; views whose track is where the car is as seen from the radar."""
    covariance = ((0.04, 0.0), (0.0, 0.04))
    with RecordingWriter(path, {}) as writer:
        for scan in range(REST_SCANS + DRIVE_SCANS):
            at_ns, driven_s = START_NS + scan * PERIOD_NS, 0.3 * max(scan - REST_SCANS, 0)
            for part in range(6):
                stamp_ns = at_ns + part * PERIOD_NS // 6
                # until the stamp of scan REST_SCANS it stands, and drives from there at once
                speed_mps = SPEED_MPS if scan >= REST_SCANS else 0.0
                state = VehicleState(stamp_ns=stamp_ns, speed_mps=speed_mps, yaw_rate_rps=BIAS_RPS)
                writer.write("vehicle/state", state, publisher="car", sequence=6 * scan + part, sent_ns=stamp_ns)
            x_m, y_m = CAR_AT + 0.3 * scan * CAR_VELOCITY - np.array([SPEED_MPS * driven_s, 0.0])
            one = example_track(
                x_m=x_m,
                y_m=y_m,
                velocity_x_mps=CAR_VELOCITY[0],
                velocity_y_mps=CAR_VELOCITY[1],
                age_s=0.3 * scan,
                cov_m2=covariance,
                velocity_cov_m2ps2=covariance,
                time_to_appear_s=max(2.0 - 0.1 * (scan - 40), 0.0) if scan >= 40 else None,
            )
            flags = ("saturated",) if 10 <= scan < 20 else ()
            view = example_view(stamp_ns=at_ns, scan_id=scan, tracks=(one,) if tracks else (), flags=flags)
            sent_ns = at_ns + PERIOD_NS + 50_000_000
            writer.write("perception/hidden_objects", view, publisher="geometry", sequence=scan, sent_ns=sent_ns)
            # a graph under load: the map of a scan comes before the view of the scan before
            ra_map = small_map(scan, at_ns)
            writer.write("radar/ra_map", ra_map, publisher="former", sequence=scan, sent_ns=sent_ns - 400_000_000)
    return path


@pytest.fixture
def drive(tmp_path: Path) -> Iterator[Playback]:
    with RecordingReader(write_drive(tmp_path / "drive.mcap")) as reader:
        yield Playback(reader, Board())


def everything(playback: Playback) -> dict[str, list[Any]]:
    """All messages that a page would get, as they are, but for where playing stands."""
    board = playback._board
    hung = board.newer({})
    del hung["timeline"]
    return {kind: list(board.messages(kind, posted)) for kind, posted in hung.items()}


def test_a_seek_shows_the_same_as_playing_through(drive: Playback) -> None:
    """Every scan, by playing from the start and by jumping to and fro: the same bytes, trails and warnings included."""
    played = []
    for index in range(drive.count):
        drive.show(index)
        played.append(everything(drive))
    for index in np.random.default_rng(0).permutation(drive.count).tolist():
        drive.show(index)
        assert everything(drive) == played[index]
    assert len({str(one["view"]) for one in played}) == len({str(one["map"]) for one in played}) == drive.count


@pytest.mark.parametrize("index", [20, 35, 59])
def test_trails_stay_where_they_were_over_ground(drive: Playback, index: int) -> None:
    """At rest, as it sets off, under way: earlier places lie on the car's straight line, seen from where the radar is.

    The bias of 0.02 rad/s, not taken off, would turn 5 s old places by 0.1 rad: 4 m at this distance. Bound 0.1 m:
    speed between two states is taken as changing evenly, 50 ms at the start of the drive (0.1 m).
    """
    drive.show(index)
    trail = np.array(shown(drive)["view"]["tracks"][0]["trail"]).reshape(-1, 2)
    ages_s = 0.3 * np.arange(len(trail))[::-1]
    driven_m = SPEED_MPS * 0.3 * max(index - REST_SCANS, 0)
    expected = CAR_AT + (0.3 * index - ages_s)[:, None] * CAR_VELOCITY - np.array([driven_m, 0.0])
    assert len(trail) == 17
    assert np.abs(trail - expected).max() < 0.11


def test_warnings_and_marks_say_when_it_was(drive: Playback) -> None:
    told = shown(drive)
    marks = {one["key"]: one for one in told["overview"]["marks"]}
    assert len(told["overview"]["times_s"]) == len(told["overview"]["seen"]) == drive.count
    # at last it has passed to the right
    assert set(marks) == {"blind", "flag/saturated", "hidden/left", "hidden/right"}
    saturated, hidden = marks["flag/saturated"], marks["hidden/left"]
    # first seen in scan 10; the memory holds it a second beyond scan 19, which does not count
    assert (saturated["from_s"], saturated["to_s"]) == (pytest.approx(3.0), pytest.approx(5.9, abs=0.31))
    assert hidden["level"] == "urgent"
    drive.show(45)
    (first, *_) = shown(drive)["warnings"]["warnings"]
    assert first["key"] == "hidden/left"
    assert first["level"] == "urgent"


def mark_rows(told: list[tuple[float, Level | None]]) -> list[tuple[str, float, float]]:
    """Level, start and end of the marks of one warning that is told so, time by time."""
    marks = _Marks()
    began_s = {}
    for time_s, level in told:
        if level is None:
            marks.add((), round(1e9 * time_s))
            continue
        began_s.setdefault(level, time_s)
        one = DriverWarning("hidden/left", level, level.name, "", round(1e9 * began_s[level]), None, (), False)
        marks.add((one,), round(1e9 * time_s))
    return [(one.title, one.start_ns / 1e9, one.end_ns / 1e9) for one in marks.closed()]


def test_a_warning_that_becomes_urgent_is_marked_urgent_from_then_only() -> None:
    told = [(0.0, Level.NOTICE), (0.3, Level.NOTICE), (0.6, Level.URGENT), (0.9, Level.URGENT), (1.2, Level.NOTICE)]
    assert mark_rows([*told, (1.5, None)]) == [("NOTICE", 0.0, 0.3), ("URGENT", 0.6, 0.9), ("NOTICE", 1.2, 1.2)]


def test_what_was_over_before_the_first_scan_is_not_marked(tmp_path: Path) -> None:
    """Five seconds without a view, then scans: "No view yet" is no mark on the first scan."""
    path = tmp_path / "late.mcap"
    view = example_view()
    with RecordingWriter(path, {}) as writer:
        state = VehicleState(stamp_ns=0)
        writer.write("vehicle/state", state, publisher="c", sequence=0, sent_ns=0)
        for sequence, sent_ns in enumerate([5 * 10**9, 5 * 10**9 + PERIOD_NS]):
            seen = msgspec.structs.replace(view, stamp_ns=sent_ns)
            writer.write("perception/hidden_objects", seen, publisher="g", sequence=sequence, sent_ns=sent_ns)
    with RecordingReader(path) as reader:
        log = read_log(reader)
    assert "silent" in {one.key for one in log.marks}
    assert "silent" not in {one["key"] for one in overview_json(log)["marks"]}


def test_a_recording_without_tracks_is_shown_without(tmp_path: Path) -> None:
    with RecordingReader(write_drive(tmp_path / "old.mcap", tracks=False)) as reader:
        playback = Playback(reader, Board())
        for index in (0, 40, 59):
            playback.show(index)
            told = shown(playback)
            assert told["view"]["tracks"] == []
            assert not [one for one in told["warnings"]["warnings"] if one["key"].startswith("hidden/")]


def test_a_hole_of_years_in_the_stamps_is_passed(tmp_path: Path) -> None:
    """A clock set anew in the middle of a recording: the silence is told, and not looked into for ever."""
    path = tmp_path / "hole.mcap"
    view = example_view()
    with RecordingWriter(path, {}) as writer:
        for sequence, sent_ns in enumerate([0, 10**17, 10**17 + PERIOD_NS]):
            writer.write("perception/hidden_objects", view, publisher="g", sequence=sequence, sent_ns=sent_ns)
    with RecordingReader(path) as reader:
        playback = Playback(reader, Board())
        assert playback.count == 3
        assert "silent" in {one["key"] for one in shown(playback)["overview"]["marks"]}


def test_a_loop_begins_anew_after_the_last_scan(playback: Playback) -> None:
    playback.obey([Seek(SCANS - 1), Play(1.0, loop=True)], now_s=0.0)
    assert playback.index == 0
    playback.obey([Seek(SCANS - 1)], now_s=0.0)
    # the last scan stays for a second
    assert playback._due_s == 1.0
    playback._advance(1.0)
    assert (playback.index, playback.playing) == (0, True)
    playback.obey([Play(1.0)], now_s=2.0)
    assert shown(playback)["timeline"]["loop"] is False


def test_a_recording_without_views_is_refused(tmp_path: Path) -> None:
    with (
        RecordingReader(write_recording(tmp_path / "b.mcap", views=False)) as reader,
        pytest.raises(ValueError, match=r"b\.mcap: holds no perception/hidden_objects to show"),
    ):
        Playback(reader, Board())


def test_a_cut_recording_is_shown_and_says_so(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "c.mcap")
    path.write_bytes(path.read_bytes()[:-200])
    with RecordingReader(path) as reader:
        assert shown(Playback(reader, Board()))["timeline"]["loss"]
