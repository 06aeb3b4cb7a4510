"""`mirrorwave view`: a recording under the same page, moved by seek, step and time."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mirrorwave.playback import MAX_SPEED, Playback
from mirrorwave.view import view
from msgs.diagnostics import NodeState, NodeStatus
from msgs.perception import BevFrame, BevGrid, SceneTruth
from msgs.radar import RangeAzimuthGrid, RangeAzimuthMap
from msgs.recording import RecordingReader, RecordingWriter
from msgs.vehicle import VehicleState
from nodes.viewer.board import Board
from nodes.viewer.server import Play, Seek, Step

SCANS = 20
PERIOD_NS = 300_000_000
START_NS = 50_000_000_000


def write_recording(path: Path, views: bool = True) -> Path:
    """A run of the graph: each scan's map, truth and view, the truth of odd scans a little after the view."""
    empty, grid = np.zeros((0, 3), np.float32), RangeAzimuthGrid(range_bins=8, azimuth_bins=4)
    with RecordingWriter(path, {}) as writer:
        for scan in range(SCANS):
            at_ns = START_NS + scan * PERIOD_NS
            messages: list[tuple[str, Any, int]] = [
                ("vehicle/state", VehicleState(stamp_ns=at_ns, speed_mps=float(scan)), 0),
                ("diagnostics/node", NodeStatus(stamp_ns=at_ns, node="geometry", pid=1, state=NodeState.READY), 1),
                (
                    "radar/ra_map",
                    RangeAzimuthMap(
                        stamp_ns=at_ns, scan_id=100 + scan, grid=grid, values=np.ones((8, 4), np.complex64),
                        azimuth_stamp_ns=np.zeros(4, np.int64), noise_power_mw=1.0, incoherent=np.zeros(8, bool),
                    ),
                    2,
                ),
                (
                    "perception/hidden_objects",
                    BevFrame(
                        stamp_ns=at_ns, scan_id=100 + scan, grid=BevGrid(rows=2, columns=2),
                        visibility=np.zeros((2, 2), np.uint8), los_points_m=np.zeros((0, 2), np.float32),
                    ),
                    3_000_000,
                ),
                (
                    "sim/truth",
                    SceneTruth(
                        stamp_ns=at_ns, scan_id=100 + scan, los_points_m=empty, mirrored_points_m=empty,
                        hidden_points_m=empty, hidden_object=np.zeros(0, np.int32),
                    ),
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
    return {kind: json.loads(board.messages(kind, posted)[0]) for kind, posted in board.newer({}).items()}


def test_it_opens_at_the_first_scan(playback: Playback) -> None:
    told = shown(playback)
    assert (playback.count, playback.index) == (SCANS, 0)
    assert told["timeline"] == {
        "type": "timeline", "index": 0, "count": SCANS, "time_s": 0.0, "duration_s": 5.7, "playing": False,
        "loss": None,
    }  # fmt: skip
    assert told["view"]["scan_id"] == told["map"]["scan_id"] == 100


@pytest.mark.parametrize("path", [[7], [7, 8], [19, 3], [8, 7], [4, 5, 6, 7], [1, 1]])
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
