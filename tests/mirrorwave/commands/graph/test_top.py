"""`mirrorwave top`: what it makes of heartbeats and views, and the verb on a quiet and on a living domain."""

from __future__ import annotations

import io
import json
import threading
from pathlib import Path

import msgspec
import pytest

from mirrorwave.cli import main
from mirrorwave.commands.graph.top import MAX_HEARTBEATS, GraphWatch, _picture
from msgs.values.diagnostics import NodeState, NodeStatus, ShedCount, StageTime, TopicCount
from msgs.values.radar import BeamGrid, RadarSetup
from nodes.inputs.view_latency import last_beam_ns
from nodes.viewer.node_table import MAX_NODES
from tests.nodes.test_bev_viewer import frame

S = 1_000_000_000


def status(second: float, node: str = "ra_former", **changes: object) -> NodeStatus:
    fields = {
        "stamp_ns": 0, "node": node, "pid": 1, "state": NodeState.READY, "uptime_s": second, "cpu_s": 0.25 * second,
        "resident_bytes": 100 << 20,
    }  # fmt: skip
    return NodeStatus(**{**fields, **changes})  # type: ignore[arg-type]


def watched(window_s: float = 5.0) -> GraphWatch:
    """Twenty heartbeats and 34 views of ten seconds; every third view is late, what is shed grows by the beat."""
    watch = GraphWatch(0, window_s)
    for beat in range(20):
        stage = StageTime(name="beam", count=2, last_ms=3.0, mean_ms=2.0, max_ms=3.0, samples_ms=(1.0, 3.0))
        shed = (ShedCount(what="scan", reason="behind", count=10 + beat),)
        lost = TopicCount(topic="radar/beam", messages=9, bytes=9, lost=2, outdated=4)
        watch.take(status(0.5 * beat, stages=(stage,), shed=shed, received=(lost,)), beat * S // 2)
    for scan in range(34):
        stamp_ns = 3 * scan * S // 10
        late_ns = S // 2 if scan % 3 == 0 else S // 10
        view = msgspec.structs.replace(frame(scan), stamp_ns=stamp_ns)
        watch.take(view, stamp_ns + last_beam_ns() + late_ns)
    return watch


def test_the_report_says_what_there_is_to_say() -> None:
    report = watched().report(10 * S)
    (row,) = report["nodes"]
    assert (row["node"], row["state"], row["lost"], row["outdated"]) == ("ra_former", "ready", 2, 4)
    assert row["cpu_percent"] == pytest.approx(25.0)
    assert row["resident_bytes"] == 100 << 20
    (stage,) = row["stages"]
    # the eleven heartbeats of the last five seconds
    assert stage == {"name": "beam", "count": 22, "mean_ms": 2.0, "p50_ms": 2.0, "p99_ms": 3.0, "max_ms": 3.0}
    assert row["shed"] == [{"what": "scan", "reason": "behind", "count": 29, "window": 10}]
    graph = report["graph"]
    assert graph["misses_total"] == 12
    assert 0 < graph["misses"] < 12
    assert graph["latency_p50_ms"] == pytest.approx(100.0, abs=0.01)
    assert graph["latency_max_ms"] == pytest.approx(500.0, abs=0.01)
    json.dumps(report, allow_nan=False)


def test_the_window_is_the_window() -> None:
    (row,) = watched(window_s=1.0).report(10 * S)["nodes"]
    assert row["stages"][0]["count"] == 6
    assert row["shed"][0]["window"] == 2


def test_beams_and_their_time_on_air_are_those_of_the_setup() -> None:
    watch = GraphWatch(0)
    one = RadarSetup(beams=BeamGrid(azimuth_deg=(0.0,)))
    watch.take(one, 0)
    watch.take(msgspec.structs.replace(frame(0), stamp_ns=0), last_beam_ns(one) + S // 100)
    assert watch.report(S)["graph"]["latency_max_ms"] == pytest.approx(10.0)


def test_a_node_that_ended_is_left_out_and_a_silent_one_is_named() -> None:
    watch = GraphWatch(0)
    watch.take(status(1.0, "a", state=NodeState.STOPPING), 0)
    watch.take(status(1.0, "b"), 0)
    (row,) = watch.report(10 * S)["nodes"]
    assert (row["node"], row["state"], row["reason"]) == ("b", "silent", "no heartbeat for 10 s")


def test_a_new_process_starts_afresh() -> None:
    watch = GraphWatch(0)
    watch.take(status(100.0, shed=(ShedCount(what="scan", reason="behind", count=50),)), 0)
    watch.take(status(0.5, pid=2, shed=(ShedCount(what="scan", reason="behind", count=3),)), S)
    watch.take(status(1.0, pid=2, shed=(ShedCount(what="scan", reason="behind", count=5),)), 2 * S)
    (row,) = watch.report(2 * S)["nodes"]
    assert row["shed"] == [{"what": "scan", "reason": "behind", "count": 5, "window": 2}]


def test_the_table_shows_it_all() -> None:
    from rich.console import Console

    out = io.StringIO()
    Console(file=out, width=400).print(_picture({"domain": "default", **watched().report(10 * S)}))
    text = out.getvalue()
    for part in (
        "domain default: view",
        "views/s",
        "deadline 0.3 s missed",
        "12x in 10 s",
        "29 scans behind",
        "P99 MS",
    ):
        assert part in text


def test_before_the_first_heartbeat_the_table_says_so() -> None:
    assert "no heartbeat yet" in str(_picture({"domain": "x", **GraphWatch(0).report(1)}))


@pytest.mark.graph
def test_one_object_after_one_window(quiet_domain: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from msgs.bus.zmq import ZmqBus, run_dir

    ended = threading.Event()

    def speak() -> None:
        bus = ZmqBus("ra_former", run_dir("default"))
        beat = 0
        while not ended.wait(0.05):
            beat += 1
            bus.publish("diagnostics/node", status(0.05 * beat))
            view = msgspec.structs.replace(frame(beat), stamp_ns=bus.now_ns() - last_beam_ns())
            bus.publish("perception/hidden_objects", view)
        bus.close()

    thread = threading.Thread(target=speak)
    thread.start()
    try:
        assert main(["top", "--json", "--window", "1.5"]) == 0
    finally:
        ended.set()
        thread.join()
    told = json.loads(capsys.readouterr().out)
    assert told["domain"] == "default"
    assert [row["node"] for row in told["nodes"]] == ["ra_former"]
    assert told["graph"]["views"] > 0
    assert told["graph"]["age_ms"] is not None


def test_invented_nodes_and_a_flood_of_heartbeats_take_no_memory() -> None:
    """The names heard last stay, and of each the newest heartbeats."""
    watch = GraphWatch(0)
    for number in range(3000):
        watch.take(status(0.0, f"invented{number}"), number)
    for number in range(3000):
        watch.take(status(1e-3 * number), 3000 + number)
    nodes = [row["node"] for row in watch.report(6000)["nodes"]]
    assert len(nodes) == MAX_NODES
    assert {"ra_former", "invented2999"} <= set(nodes)
    assert len(watch._heard["ra_former"]) == MAX_HEARTBEATS


def test_names_that_a_peer_makes_up_do_not_drive_out_the_nodes_of_this_host() -> None:
    watch = GraphWatch(0)
    watch.take(status(0.0), 0)
    for number in range(3000):
        watch.take(status(0.0, f"sensor.invented{number}"), 1 + number)
    nodes = [row["node"] for row in watch.report(3001)["nodes"]]
    assert len(nodes) == MAX_NODES
    assert {"ra_former", "sensor.invented2999"} <= set(nodes)
