"""What the page is told: exact values, tile headers and codes, and health of the nodes."""

from __future__ import annotations

import json
import math
import struct
import subprocess
import sys

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib import colormaps

from msgs.values.diagnostics import NodeState, NodeStatus, ShedCount, StageTime, TopicCount
from msgs.values.lidar import LidarSetup, SpadParams
from msgs.values.perception import (
    BevFrame,
    BevGrid,
    HiddenObject,
    HiddenPoint,
    Peaks,
    SceneTruth,
    Track,
    TruthObject,
    TruthSurface,
    Wall,
)
from msgs.values.radar import PRESETS, RadarParams, RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from nodes.viewer import view_model
from nodes.viewer.assembly import Assembly
from nodes.viewer.newest import Board, json_text
from nodes.viewer.node_table import MAX_ENTRIES, MAX_HEARTBEATS, MAX_NODES, SILENT_NS, NodeTable
from nodes.viewer.view_model import MAX_TRACKS, STEP_DB, ellipse, map_json, map_tile, mask_tile, summary_text, view_json
from tests.builders import example_map, example_truth

HEADER = struct.Struct("<2sBBIHHhH")
S = 1_000_000_000


def hidden(identity: int = 0, x_m: float = 11.6, y_m: float = 8.5, stamp_ns: int = 0) -> HiddenObject:
    cov = ((0.25, 0.0), (0.0, 1.0))
    return HiddenObject(
        id=identity, x_m=x_m, y_m=y_m, length_m=4.4, width_m=1.8, yaw_rad=0.5, score=0.9134, cov_m2=cov,
        stamp_ns=stamp_ns, points=3, object_class="van",
    )  # fmt: skip


def frame(objects: tuple[HiddenObject, ...] = (), visibility: np.ndarray | None = None, scan_id: int = 7) -> BevFrame:
    visibility = np.zeros((2, 3), np.uint8) if visibility is None else visibility
    return BevFrame(
        stamp_ns=1_234_567_890,
        scan_id=scan_id,
        walls=(Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -9.0), (20.0, 9.126)), inliers=9),),
        points=(HiddenPoint(x_m=11.001, y_m=8.0, score=0.876, image_x_m=29.0, image_y_m=8.0, wall=0),),
        objects=objects,
        tracks=(
            Track(
                id=4, x_m=1.0, y_m=2.0, velocity_x_mps=3.0, velocity_y_mps=-1.0, age_s=1.24,
                cov_m2=((1.0, 0.0), (0.0, 1.0)), time_to_appear_s=2.5, existence=0.9123, object_class="van",
            ),
        ),
        los_points_m=np.array([[20.0, -1.5], [20.004, 2.0]], np.float32),
        grid=BevGrid(x_min_m=0.0, y_min_m=-1.0, cell_m=1.0, rows=visibility.shape[0], columns=visibility.shape[1]),
        visibility=visibility,
        flags=("incoherent",),
    )  # fmt: skip


def truth(scan_id: int = 7, stamp_ns: int = 0) -> SceneTruth:
    car = TruthObject(
        id=0, object_class="car", x_m=11.0, y_m=9.3, length_m=4.5, width_m=1.8, yaw_rad=-1.5, velocity_x_mps=2.0,
        hidden=True,
    )  # fmt: skip
    wall = TruthSurface(role="relay", material="brick", polyline_m=((20.0, -9.0), (20.0, 9.0)))
    return example_truth(stamp_ns=stamp_ns, scan_id=scan_id, objects=(car,), surfaces=(wall,))


def ra_map(values: np.ndarray, noise_power_mw: float = 1.0, scan_id: int = 7) -> RangeAzimuthMap:
    grid = RangeAzimuthGrid(range_bins=values.shape[0], azimuth_bins=values.shape[1])
    return example_map(
        values,
        scan_id=scan_id,
        grid=grid,
        noise_power_mw=noise_power_mw,
        incoherent=np.arange(values.shape[0]) < values.shape[0] // 2,
        missing_beams=(3,),
    )


def peaks(scan_id: int = 7) -> Peaks:
    one = np.ones(1)
    return Peaks(
        stamp_ns=0, scan_id=scan_id, range_m=22.126 * one, azimuth_rad=0.1234 * one, score=0.5 * one,
        path_class=np.ones(1, np.uint8), covariance=np.eye(2)[None], peak_stamp_ns=np.zeros(1, np.int64),
        snr_db=30.0 * one,
    )  # fmt: skip


def test_a_view_is_told_exactly() -> None:
    vehicle = VehicleState(stamp_ns=0, speed_mps=3.456, yaw_rate_rps=0.01)
    told = view_json(frame((hidden(),)), truth(), vehicle)
    assert told["scan_id"] == 7
    assert told["stamp_s"] == 1.235
    assert told["summary"] == "1 hidden object at 11.6, 8.5 m"
    assert told["walls"] == [{"ends": [20.0, -9.0, 20.0, 9.13], "normal": [-1.0, 0.0], "inliers": 9}]
    assert told["los"] == [20.0, -1.5, 20.0, 2.0]
    assert told["points"] == [[11.0, 8.0, 29.0, 8.0, 0.88, 0]]
    assert told["objects"] == [
        {
            # 0.6 m and 0.8 m from the car's centre at (11, 9.3): 1 m by Pythagoras, and no face of it is visible
            "nearest": {"class": "car", "face_error": 1.0, "centre_error": 1.0},
            "id": 0, "at": [11.6, 8.5], "centre": [11.6, 8.5], "size": [4.4, 1.8], "yaw": 0.5, "score": 0.913,
            "class": "van",
            "ellipse": [2.0, 1.0, 1.5708], "points": 3,
        }
    ]  # fmt: skip
    assert told["tracks"] == [
        {
            "id": 4, "at": [1.0, 2.0], "ellipse": [2.0, 2.0, 1.5708], "velocity": [3.0, -1.0],
            "velocity_ellipse": None, "age_s": 1.2, "appears_s": 2.5, "misses": 0,
            "existence": 0.912, "class": "van", "trail": [],
        }
    ]  # fmt: skip
    assert told["tracks_total"] == 1
    assert told["truth"]["objects"][0]["at"] == [11.0, 9.3]
    assert told["truth"]["surfaces"][0]["line"] == [20.0, -9.0, 20.0, 9.0]
    assert told["vehicle"] == {"speed_mps": 3.46, "yaw_rate_rps": 0.01, "valid": True, "reason": ""}
    assert told["flags"] == ["incoherent"]


def test_errors_are_to_the_visible_face_and_to_the_centre() -> None:
    """The front of a car along x is seen, at x = 13.25; an object 0.5 m before it is 2.75 m off the centre."""
    replace, front = msgspec.structs.replace, np.array([[13.25, 9.0, 0.0]], np.float32)
    along_x = replace(truth().objects[0], yaw_rad=0.0, velocity_x_mps=0.0)
    seen = replace(
        truth(), objects=(along_x,), mirrored_points_m=front, hidden_points_m=front, hidden_object=np.zeros(1, np.int32)
    )
    (told,) = view_json(frame((hidden(x_m=13.75, y_m=9.3),)), seen, None)["objects"]
    assert told["nearest"] == {"class": "car", "face_error": 0.5, "centre_error": 2.75}


def test_no_error_is_told_against_no_truth() -> None:
    for what in (msgspec.structs.replace(truth(), objects=()), None):
        assert view_json(frame((hidden(),)), what, None)["objects"][0]["nearest"] is None


def test_the_page_loads_no_compiler() -> None:
    """The viewer is the lightest node: numba alone would double its memory and its time to start."""
    code = "import sys, nodes.bev_viewer; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=300).returncode == 0


def test_of_many_tracks_the_most_pressing_are_told() -> None:
    """1000 of them, one in three without a time, one of old: the rest is counted."""
    one = frame().tracks[0]
    replace = msgspec.structs.replace
    crowd = [
        replace(one, id=index, x_m=float(index), time_to_appear_s=None if index % 3 else 0.005 * (1000 - index))
        for index in range(1000)
    ]
    crowd[999] = replace(crowd[999], time_to_appear_s=None)
    crowd[996] = replace(crowd[996], id=2**62, age_s=1e7)
    told = view_json(replace(frame(), tracks=tuple(crowd)), None, None)
    assert told["tracks_total"] == 1000
    assert len(told["tracks"]) == MAX_TRACKS
    assert (told["tracks"][0]["id"], told["tracks"][0]["age_s"]) == (2**62, 1e7)
    times = [one["appears_s"] for one in told["tracks"]]
    assert times == sorted(times)
    assert told["summary"] == "no hidden object"


def test_nothing_known_is_null_not_absent() -> None:
    told = view_json(frame(), None, None)
    assert told["truth"] is None
    assert told["vehicle"] is None
    assert told["objects"] == []


def test_truth_stands_where_it_was_when_it_was_measured() -> None:
    """2 m/s forward, measured half a second after the truth's stamp: 1 m on."""
    told = view_json(frame((hidden(stamp_ns=1_500_000_000),)), truth(stamp_ns=1_000_000_000), None)
    assert told["truth"]["objects"][0]["at"] == [12.0, 9.3]


@pytest.mark.parametrize(
    ("objects", "text"),
    [
        ((), "no hidden object"),
        ((hidden(),), "1 hidden object at 11.6, 8.5 m"),
        ((hidden(), hidden(1, 3.0, -4.06)), "2 hidden objects at 11.6, 8.5 m and 3.0, -4.1 m"),
        ((hidden(), hidden(1), hidden(2)), "3 hidden objects at 11.6, 8.5 m; 11.6, 8.5 m and 11.6, 8.5 m"),
    ],
)
def test_the_summary_is_a_sentence(objects: tuple[HiddenObject, ...], text: str) -> None:
    assert summary_text(frame(objects)) == text


@given(
    major=st.floats(0.01, 50.0), ratio=st.floats(0.0, 0.9), angle=st.floats(-1.5, 1.5)
)  # away from circles and from +-90 degrees, where the direction is not unique
@settings(max_examples=50, deadline=None)
def test_the_ellipse_is_the_covariance(major: float, ratio: float, angle: float) -> None:
    """Two sigma along the axes of a covariance made of them; eigh is exact to a few ulp of the larger variance."""
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    covariance = turn @ np.diag([major**2, (ratio * major) ** 2]) @ turn.T
    got_major, got_minor, got_angle = ellipse(covariance.tolist())
    assert got_major == pytest.approx(2.0 * major, rel=1e-12)
    # an error of eps major^2 in the smaller variance is sqrt(eps) major in its root, at worst
    assert got_minor == pytest.approx(2.0 * ratio * major, abs=2e-7 * major)
    assert got_angle == pytest.approx(angle, abs=1e-12)


def test_levels_become_codes_over_the_noise() -> None:
    """Amplitude 10 over noise 1 is 20 dB: code 50 of 0.4 dB; below the noise is 0, beyond 102 dB is 255."""
    values = np.array([[10.0, 0.1], [1e6, 0.0], [1.0, 100.0]])
    tile = map_tile(ra_map(values))
    assert HEADER.unpack(tile[:16]) == (b"MW", 1, 1, 7, 3, 2, 0, 400)
    assert list(tile[16:]) == [50, 0, 255, 0, 0, 100]
    assert STEP_DB == 0.4


def test_a_cell_whose_power_overflows_counts_as_empty() -> None:
    """3e38 is a float32, its square none."""
    assert list(map_tile(ra_map(np.array([[3e38, 10.0]])))[16:]) == [0, 50]


def test_without_noise_levels_hang_from_the_peak() -> None:
    tile = map_tile(ra_map(np.array([[1e-3, 1e-4]]), noise_power_mw=0.0))
    assert HEADER.unpack(tile[:16])[-2:] == (-10200, 400)
    assert list(tile[16:]) == [255, 205]
    assert map_json(ra_map(np.ones((2, 2)), 0.0), None)["reference"] == "peak"


@pytest.mark.parametrize("noise_power_mw", [0.0, 1.0, 5e-324, 1e30])
def test_an_empty_map_is_black(noise_power_mw: float) -> None:
    nothing = ra_map(np.zeros((3, 4)), noise_power_mw)
    assert set(map_tile(nothing)[16:]) == {0}
    assert "null" not in json_text({**map_json(nothing, None), "peaks": []})


def test_a_large_map_is_pooled_and_keeps_its_peaks() -> None:
    values = np.ones((1025, 256))
    values[1024, 255] = 1000.0
    values[3, 17] = 100.0
    big = ra_map(values)
    tile = map_tile(big)
    assert HEADER.unpack(tile[:16])[4:6] == (342, 128)
    codes = np.frombuffer(tile[16:], np.uint8).reshape(342, 128)
    assert codes[341, 127] == 150
    assert codes[1, 8] == 100
    assert map_json(big, None)["pool"] == [3, 2]


def test_a_map_is_told_with_its_own_peaks_only() -> None:
    told = map_json(ra_map(np.full((4, 4), 10.0)), peaks())
    assert told["peaks"] == [[22.13, 0.1234, 1, 0.5]]
    assert told["peak_db"] == 20.0
    assert told["incoherent_share"] == 0.5
    assert told["missing_beams"] == [3]
    assert map_json(ra_map(np.ones((4, 4))), peaks(scan_id=6))["peaks"] is None


def test_the_mask_packs_four_cells_a_byte() -> None:
    visibility = np.array([[0, 1, 2], [2, 1, 2]], np.uint8)
    tile = mask_tile(frame(visibility=visibility))
    assert HEADER.unpack(tile[:16])[3:6] == (7, 2, 3)
    assert list(tile[16:]) == [0 | 1 << 2 | 2 << 4 | 2 << 6, 1 | 2 << 2]


def test_the_colours_are_cividis() -> None:
    """Linear between anchors stays within 5/255 of the table of 256 (its blue has a kink near the bottom)."""
    anchors = np.array([[int(text[at : at + 2], 16) for at in (1, 3, 5)] for text in view_model.COLOURS])
    shown = np.stack(
        [np.interp(np.linspace(0, 32, 256), np.arange(33), anchors[:, channel]) for channel in range(3)], axis=1
    )
    wanted = 255.0 * colormaps["cividis"](np.linspace(0.0, 1.0, 256))[:, :3]
    assert np.abs(shown - wanted).max() < 5.0


# the table of nodes


def status(node: str = "ra_former", second: float = 0.0, messages: int = 0, **changes: object) -> NodeStatus:
    fields = {
        "stamp_ns": 0, "node": node, "pid": 1, "state": NodeState.READY, "uptime_s": second, "cpu_s": 0.25 * second,
        "resident_bytes": 100 << 20,
        "published": (TopicCount(topic="radar/ra_map", messages=messages, bytes=0),),
        "received": (TopicCount(topic="radar/beam", messages=0, bytes=0, lost=2, rejected=1),),
    }  # fmt: skip
    return NodeStatus(**{**fields, **changes})  # type: ignore[arg-type]


def test_rates_and_load_come_from_the_last_seconds() -> None:
    table = NodeTable()
    for beat in range(31):
        table.add(status(second=0.5 * beat, messages=2 * beat), beat * S // 2)
    (row,) = table.rows(15 * S)
    assert row["rates"] == [{"topic": "radar/ra_map", "hz": 4.0}]
    assert row["cpu"] == 0.25
    assert row["memory_mib"] == 100
    assert (row["lost"], row["rejected"], row["state"]) == (2, 1, "ready")


def test_a_topic_that_nobody_knows_has_no_rate() -> None:
    """A heartbeat names any topics it likes."""
    table = NodeTable()
    for beat in range(2):
        table.add(status(second=beat, published=(TopicCount(topic="ready", messages=beat, bytes=0),)), beat * S)
    assert table.rows(S)[0]["rates"] == []


def test_one_heartbeat_has_no_rate_yet() -> None:
    table = NodeTable()
    table.add(status(messages=5), 0)
    assert table.rows(0)[0]["rates"] == [{"topic": "radar/ra_map", "hz": 0.0}]


def test_a_restarted_node_starts_afresh() -> None:
    table = NodeTable()
    table.add(status(second=100.0, messages=1000), 0)
    table.add(status(second=0.5, messages=1, pid=2), S)
    table.add(status(second=1.5, messages=4, pid=2), 2 * S)
    assert table.rows(2 * S)[0]["rates"] == [{"topic": "radar/ra_map", "hz": 3.0}]


def test_stages_stay_until_the_next_are_known() -> None:
    table = NodeTable()
    stage = StageTime(name="fold", count=2, last_ms=1.0, mean_ms=1.26, max_ms=2.04)
    table.add(status(stages=(stage,)), 0)
    table.add(status(second=0.5), S)
    assert table.rows(S)[0]["stages"] == [{"name": "fold", "mean_ms": 1.3, "max_ms": 2.0}]


def test_what_a_node_left_undone_is_said_in_words() -> None:
    table = NodeTable()
    table.add(status(shed=(ShedCount(what="scan", reason="behind", count=12),)), 0)
    assert table.rows(0)[0]["shed"] == ["12 scans behind"]


def test_a_node_that_says_nothing_is_silent_unless_it_ended() -> None:
    table = NodeTable()
    table.add(status("a"), 0)
    table.add(status("b", state=NodeState.STOPPING, reason="done"), 0)
    rows = {row["node"]: row for row in table.rows(SILENT_NS + S)}
    assert (rows["a"]["state"], rows["a"]["reason"]) == ("silent", "no heartbeat for 4 s")
    assert (rows["b"]["state"], rows["b"]["reason"]) == ("stopping", "done")


def test_nodes_stand_in_the_order_of_the_stream() -> None:
    table = NodeTable()
    published = {"viewer": (), "geometry": ("perception/hidden_objects",), "player": ("log", "radar/beam")}
    for name, topics in published.items():
        counts = tuple(TopicCount(topic=topic, messages=0, bytes=0) for topic in topics)
        table.add(status(name, published=counts), 0)
    assert [row["node"] for row in table.rows(0)] == ["player", "geometry", "viewer"]


def test_a_peer_s_names_do_not_drive_out_the_nodes_of_this_host() -> None:
    table = NodeTable()
    table.add(status("geometry"), 0)
    for index in range(2 * MAX_NODES):
        table.add(status(f"sensor.n{index}"), 1 + index)
    names = {row["node"] for row in table.rows(0)}
    assert len(names) == MAX_NODES
    assert {"geometry", f"sensor.n{2 * MAX_NODES - 1}"} <= names


@pytest.mark.parametrize(
    ("setup", "words"),
    [
        (RadarSetup(), "X-band radar, 10 GHz, 25 beams"),
        (PRESETS["77ghz"], "77 GHz radar, 57 channels, digital"),
        (RadarSetup(radar=RadarParams(carrier_hz=24.125e9)), "24.1 GHz radar, 25 beams"),
        (LidarSetup(), "SPAD LiDAR, 850 nm, 256 azimuths"),
        (LidarSetup(spad=SpadParams(arming="gated", gates=11)), "SPAD LiDAR, 850 nm, 256 azimuths, 11 gates"),
    ],
)
def test_the_page_is_told_which_sensor_it_looks_through(setup: RadarSetup | LidarSetup, words: str) -> None:
    told = view_model.sensor_json(setup)
    assert told["text"] == words
    assert told["name"] == ("LiDAR" if isinstance(setup, LidarSetup) else "radar")
    assert 0.0 < told["scan_s"] <= told["scan_period_s"] * (1.0 + 1e-9)


def test_a_picture_is_live_under_its_deadline_late_above_it_and_old_above_a_second() -> None:
    """The radar's scan takes 288.7 ms; its view has 300 ms, and so has the next, 300 ms later."""
    assert view_model.age_limits_ms(RadarSetup(), was_late=False) == {"late_ms": 888.7, "old_ms": 1000.0}
    assert view_model.age_limits_ms(None, was_late=False) == {"late_ms": 888.7, "old_ms": 1000.0}
    assert view_model.age_limits_ms(RadarSetup(), was_late=True) == {"late_ms": 0.0, "old_ms": 1000.0}
    # pictures of a sensor whose scans take longer are older than a second by nature
    slow = RadarSetup(radar=RadarParams(scan_period_s=3.0))
    assert view_model.age_limits_ms(slow, was_late=False)["old_ms"] == pytest.approx(2880.7 + 300.0 + 3000.0, abs=0.1)


@pytest.mark.parametrize(("arrived_ms", "late_ms"), [(588.6, 888.7), (588.8, 0.0), (43_800.0, 0.0)])
def test_what_came_after_its_deadline_is_never_live(arrived_ms: float, late_ms: float) -> None:
    board = Board()
    Assembly(board).take(msgspec.structs.replace(frame(), stamp_ns=0), round(1e6 * arrived_ms))
    told = json.loads(board.messages("view", board.newer({})["view"])[0])
    assert (told["age_ms"], told["late_ms"], told["old_ms"]) == (arrived_ms, late_ms, 1000.0)


def test_a_peer_that_invents_all_it_can_fills_neither_table_nor_page() -> None:
    """Names, heartbeats, stages, topics, reasons: whatever stands on the bus, a row stays a row."""
    table = NodeTable()
    stages = tuple(StageTime(name=f"s{n}", count=1, last_ms=1.0, mean_ms=1.0, max_ms=1.0) for n in range(1000))
    topics = tuple(TopicCount(topic=f"t{n}", messages=1, bytes=1) for n in range(1000))
    shed = tuple(ShedCount(what="x", reason=str(n), count=1) for n in range(1000))
    for number in range(1000):
        status = NodeStatus(
            stamp_ns=0, node=f"n{number % 100}", pid=1, state=NodeState.READY, reason="r" * 100_000, stages=stages,
            published=topics, shed=shed,
        )  # fmt: skip
        table.add(status, number)
    for number in range(1000):
        table.add(NodeStatus(stamp_ns=0, node="one", pid=1, state=NodeState.READY), 1000 + number)
    rows = table.rows(2000)
    assert len(rows) == MAX_NODES
    assert max(len(heard) for heard in table._heard.values()) == MAX_HEARTBEATS
    assert all(len(row[name]) <= MAX_ENTRIES for row in rows for name in ("stages", "shed", "rates"))
    assert len(json_text(rows)) < MAX_NODES * 6000
