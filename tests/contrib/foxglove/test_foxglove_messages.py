"""What the Foxglove bridge makes of a message: where everything stands, its size, its units, by hand."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from contrib.foxglove.foxglove_messages import MAX_NODES, FoxgloveStream, _cores, _plane_index
from msgs.values.diagnostics import LogRecord, NodeState, NodeStatus, ShedCount, StageTime, TopicCount
from msgs.values.frames import Pose2
from msgs.values.perception import BevGrid
from msgs.values.radar import RangeAzimuthGrid
from msgs.values.vehicle import VehicleState
from nodes.inputs.view_latency import last_beam_ns
from tests.builders import example_object, example_track
from tests.fuzz.cases import peaks, ra_map, view

HIDDEN = example_object(id=7, x_m=13.0, y_m=-9.0, yaw_rad=math.pi / 3, score=0.5, object_class="car")
TRACK = example_track(id=3, velocity_x_mps=-3.0, velocity_y_mps=4.0, age_s=1.5, existence=0.75, time_to_appear_s=2.5)


def bodies(*messages: Any, at_ns: int = 0) -> dict[str, Any]:
    """The last body of each topic."""
    stream, last = FoxgloveStream(), {}
    for message in messages:
        last |= {draft.topic: draft.build() for draft in stream.drafts(message, at_ns)}
    return last


def entities(body: Any) -> dict[str, Any]:
    return {entity["id"]: entity for entity in body["entities"]}


def beat(pid: int, uptime_s: float, cpu_s: float, **more: Any) -> NodeStatus:
    status = {"stamp_ns": 1, "node": "geometry", "state": NodeState.READY, **more}
    return NodeStatus(pid=pid, uptime_s=uptime_s, cpu_s=cpu_s, **status)


@pytest.mark.parametrize(
    ("last", "cores"),
    [
        (beat(1, 10.0, 2.0), 1.5),
        # another process, one that has not run since, and none before
        (beat(2, 10.0, 2.0), None),
        (beat(1, 12.0, 5.0), None),
        (None, None),
    ],
)
def test_cores_are_those_of_one_process_between_two_heartbeats(last: NodeStatus | None, cores: float | None) -> None:
    """3 s of processor time in 2 s are 1.5 cores."""
    assert _cores(beat(1, 12.0, 5.0), last) == cores


def test_a_heartbeat_is_compared_with_the_last_of_its_node_and_sums_its_topics() -> None:
    stream = FoxgloveStream()
    counts = [TopicCount(topic=name, messages=9, bytes=9, lost=lost, rejected=2) for name, lost in (("a", 3), ("b", 4))]
    later = beat(
        1, 12.0, 5.0, resident_bytes=3 << 20, received=tuple(counts), reason="slow", stamp_ns=2_000_000_003,
        shed=(ShedCount(what="beam", reason="refused", count=5), ShedCount(what="scan", reason="late", count=6)),
        stages=(StageTime(name="fold", count=2, last_ms=1.0, mean_ms=2.0, max_ms=3.0),),
    )  # fmt: skip
    stream.drafts(beat(1, 10.0, 2.0), 0)
    # names on the bus are anybody's: of many more the first are forgotten, not this one
    for number in range(MAX_NODES - 1):
        stream.drafts(beat(1, 1.0, 1.0, node=f"other{number}"), 0)
    (draft,) = stream.drafts(later, 0)
    body = draft.build()
    assert body == {
        "timestamp": {"sec": 2, "nsec": 3}, "node": "geometry", "state": "ready", "reason": "slow", "uptime_s": 12.0,
        "cpu_cores": 1.5, "memory_mib": 3.0, "lost": 7, "rejected": 4, "shed": 11,
        "stages": [{"name": "fold", "last_ms": 1.0, "mean_ms": 2.0, "max_ms": 3.0}],
    }  # fmt: skip


def test_objects_stand_on_the_ground_and_tracks_point_along_their_velocity() -> None:
    """A box at half its height, turned by 60 deg: z = sin 30, w = cos 30; an arrow of 5 m for 5 m/s at 126.9 deg."""
    frame = msgspec.structs.replace(view(1, 10), objects=(HIDDEN,), tracks=(TRACK,))
    scene = entities(bodies(frame)["/hidden_objects/scene"])
    (cube,), (text,) = scene["objects"]["cubes"], scene["objects"]["texts"]
    assert cube["pose"]["position"] == {"x": 13.0, "y": -9.0, "z": 0.75}
    assert cube["pose"]["orientation"] == pytest.approx({"x": 0.0, "y": 0.0, "z": 0.5, "w": math.sqrt(0.75)})
    assert cube["size"] == {"x": 4.0, "y": 2.0, "z": 1.5}
    assert (text["text"], text["pose"]["position"]["z"] > 1.5) == ("car 0.50", True)
    assert scene["objects"]["metadata"] == [{"key": "object 7 score", "value": "0.5"}]
    (arrow,) = scene["tracks"]["arrows"]
    turn_rad = math.atan2(4.0, -3.0)
    assert arrow["shaft_length"] == 5.0
    assert arrow["pose"]["position"] == {"x": 1.0, "y": 2.0, "z": 1.5}
    assert arrow["pose"]["orientation"]["z"] == pytest.approx(math.sin(0.5 * turn_rad))
    (line,), (point,) = scene["walls"]["lines"], scene["points"]["spheres"]
    assert [(at["x"], at["y"]) for at in line["points"]] == [(20.0, -10.0), (20.0, 10.0)]
    assert (point["pose"]["position"]["x"], point["pose"]["position"]["y"], point["color"]["a"]) == (13.0, -9.0, 0.5)


def test_figures_of_a_view_are_its_own() -> None:
    """200 ms after its last beam; of another clock no latency is known."""
    frame = msgspec.structs.replace(
        view(4, 10), objects=(HIDDEN, msgspec.structs.replace(HIDDEN, score=0.25)), tracks=(TRACK,)
    )
    body = bodies(frame, at_ns=10 + last_beam_ns() + 200_000_000)["/views"]
    assert body["latency_ms"] == pytest.approx(200.0)
    assert "latency_ms" not in bodies(frame, at_ns=0)["/views"]
    assert (body["scan_id"], body["object_count"], body["track_count"], body["walls"]) == (4, 2, 1, 1)
    assert body["best_score"] == 0.5
    assert body["objects"][0] == {"id": 7, "class": "car", "x_m": 13.0, "y_m": -9.0, "score": 0.5}
    (track,) = body["tracks"]
    assert (track["speed_mps"], track["age_s"], track["existence"], track["time_to_appear_s"]) == (5.0, 1.5, 0.75, 2.5)


def test_a_map_is_four_grey_levels_a_decibel_with_far_up_and_left_left() -> None:
    """20 dB over the noise are 80; the cell at range bin 2, azimuth 5 is in the third line from below, sixth from the
    right. Without noise the peak is 255 and 20 dB below it are 175.
    """
    plain = ra_map(1, 10)
    values = np.full(plain.grid.shape, 1e-3, np.complex64)
    values[2, 5] = 31.6228
    image = bodies(msgspec.structs.replace(plain, values=values, noise_power_mw=10.0))["/radar/ra_map"]
    grey = np.frombuffer(image["data"], np.uint8).reshape(image["height"], image["width"])
    assert grey.shape == plain.grid.shape
    assert grey[-3, -6] == 80
    assert np.count_nonzero(grey) == 1
    values[3, 6] = 3.16228
    peak = bodies(msgspec.structs.replace(plain, values=values, noise_power_mw=0.0))["/radar/ra_map"]
    grey = np.frombuffer(peak["data"], np.uint8).reshape(image["height"], image["width"])
    assert (grey[-3, -6], grey[-4, -7]) == (255, 175)


@pytest.mark.parametrize(("range_m", "azimuth_deg"), [(50.0, 30.0), (80.0, -45.0), (60.0, 0.0)])
def test_the_map_lies_on_the_plane_where_its_cells_are(range_m: float, azimuth_deg: float) -> None:
    """One loud cell is where it stands, within a cell of the plane (0.43 m) and half an azimuth; none is outside."""
    grid = RangeAzimuthGrid()
    values = np.zeros(grid.shape, np.complex64)
    turn_rad = math.radians(azimuth_deg)
    values[np.rint(grid.range_index(range_m)).astype(int), np.rint(grid.azimuth_index(turn_rad)).astype(int)] = 1e3
    zeros = {"azimuth_stamp_ns": np.zeros(256, np.int64), "incoherent": np.zeros(512, bool)}
    loud = msgspec.structs.replace(ra_map(1, 10), grid=grid, values=values, **zeros)
    body = bodies(loud)["/radar/ra_map/plane"]
    cells = np.frombuffer(body["data"], np.uint8).reshape(-1, body["row_stride"])
    at = np.argwhere(cells == cells.max()).mean(axis=0)
    x_m = body["pose"]["position"]["x"] + (at[1] + 0.5) * body["cell_size"]["x"]
    y_m = body["pose"]["position"]["y"] + (at[0] + 0.5) * body["cell_size"]["y"]
    assert (x_m, y_m) == pytest.approx((range_m * math.cos(turn_rad), range_m * math.sin(turn_rad)), abs=0.7)
    plane, fold, _, inside = _plane_index(grid)
    assert (fold, plane.columns) == (2, 256)
    centres_m = plane.cell_centres_m()
    sector = np.abs(np.degrees(np.arctan2(centres_m[..., 1], centres_m[..., 0])))
    assert not inside[sector > 60.3].any()
    assert inside[(sector < 59.5) & (np.hypot(*np.moveaxis(centres_m, -1, 0)) < 109.0)].all()


def test_peaks_are_points_of_seven_fields() -> None:
    sent = msgspec.structs.replace(peaks(1, 10), radial_speed_mps=np.arange(14.0))
    body = bodies(sent)["/radar/peaks"]
    offsets = {field["name"]: field["offset"] for field in body["fields"]}
    assert offsets == {"x": 0, "y": 4, "z": 8, "snr_db": 12, "score": 16, "radial_speed_mps": 20, "path_class": 24}
    points = np.frombuffer(body["data"], np.uint8).reshape(-1, body["point_stride"])
    floats = points[:, :24].copy().view("<f4")
    np.testing.assert_allclose(floats[11], [27.0, -9.0, 0.0, 25.0, 0.8, 11.0], rtol=1e-6)
    assert points[:, 24].tolist() == [0] * 11 + [1] * 3


def test_frames_hang_together() -> None:
    """The radar on the vehicle as its map says; the vehicle in odometry, a metre on after 0.2 s from 3 to 7 m/s."""
    mounted = msgspec.structs.replace(ra_map(1, 10), vehicle_from_radar=Pose2(1.4, 0.2, math.pi / 2))
    body = bodies(mounted, view(1, 2_000_000_010))["/tf"]
    assert (body["parent_frame_id"], body["child_frame_id"]) == ("vehicle", "radar")
    assert (body["translation"], body["timestamp"]) == ({"x": 1.4, "y": 0.2, "z": 0.0}, {"sec": 2, "nsec": 10})
    assert body["rotation"]["z"] == pytest.approx(math.sin(math.pi / 4))
    states = [VehicleState(stamp_ns=at, speed_mps=speed) for at, speed in ((0, 3.0), (200_000_000, 7.0))]
    moved = bodies(*states)
    assert (moved["/tf"]["parent_frame_id"], moved["/tf"]["child_frame_id"]) == ("odom", "vehicle")
    assert moved["/tf"]["translation"]["x"] == pytest.approx(1.0)


def test_log_levels_are_foxgloves() -> None:
    levels = {
        level: bodies(LogRecord(stamp_ns=1, node="a", level=level, text="x"))["/log"]["level"]
        for level in ("debug", "INFO", "warning", "error", "critical", "what")
    }
    assert levels == {"debug": 1, "INFO": 2, "warning": 3, "error": 4, "critical": 5, "what": 0}


def test_the_visibility_grid_starts_at_its_corner() -> None:
    frame = view(1, 10)
    grid = BevGrid(x_min_m=3.0, y_min_m=-7.0, cell_m=0.25, rows=6, columns=5)
    body = bodies(msgspec.structs.replace(frame, grid=grid))["/hidden_objects/visibility"]
    np.testing.assert_array_equal(np.frombuffer(body["data"], np.uint8).reshape(6, 5), frame.visibility)
    assert body["pose"]["position"] == {"x": 3.0, "y": -7.0, "z": 0.0}
    assert (body["cell_size"], body["column_count"], body["row_stride"]) == ({"x": 0.25, "y": 0.25}, 5, 5)
