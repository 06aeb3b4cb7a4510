"""`mirrorwave topic`: what echo, info, bw, hz and delay make of messages, and the verbs on a living domain."""

from __future__ import annotations

import base64
import csv
import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq

from mirrorwave.cli import main
from mirrorwave.diagnose import topic_rates
from mirrorwave.diagnose.foreign_topic import decode_foreign
from mirrorwave.diagnose.topic_delay import DelayWatch
from mirrorwave.diagnose.topic_echo import CsvLines, field_of, parse_condition, text_lines
from msgs.bus.interface import Envelope, Received
from msgs.bus.zmq import ZmqBus, run_dir
from msgs.values.diagnostics import TopicCount
from msgs.values.radar import RadarSetup
from msgs.values.vehicle import VehicleState
from nodes.inputs.view_latency import last_beam_ns
from tests.builders import example_beam, example_status
from tests.nodes.test_bev_viewer import frame

S = 1_000_000_000
BODY = {
    "speed_mps": 3.0,
    "valid": True,
    "name": None,
    "box": {"x": [1.0, 2.0]},
    "objects": [{"x_m": 1.5}, {"x_m": 9.0}],
}
BEAM = example_beam(scan_id=4, samples=np.arange(2 * 8 * 2, dtype=np.int16).reshape(2, 8, 2))


pytestmark = pytest.mark.usefixtures("quiet_domain")


@pytest.fixture
def speaker() -> Iterator[Callable[[Callable[[int, int], dict[str, msgspec.Struct]]], None]]:
    """Publishes what a function of count and time gives, fifty times a second, until the test ends."""
    ended = threading.Event()
    threads: list[threading.Thread] = []

    def start(messages: Callable[[int, int], dict[str, msgspec.Struct]]) -> None:
        from msgs.bus.zmq import ZmqBus

        def speak() -> None:
            bus = ZmqBus("speaker", run_dir("default"))
            count = 0
            while not ended.wait(0.02):
                for topic, message in messages(count, bus.now_ns()).items():
                    bus.publish(topic, message)
                count += 1
            bus.close()

        threads.append(threading.Thread(target=speak))
        threads[-1].start()

    yield start
    ended.set()
    for thread in threads:
        thread.join()


def moving(count: int, now_ns: int) -> dict[str, msgspec.Struct]:
    return {"vehicle/state": VehicleState(stamp_ns=now_ns - 5_000_000, speed_mps=float(count % 4))}


def received(topic: str, message: msgspec.Struct, sent_ns: int) -> Received:
    return Received(topic, message, Envelope(publisher="a", topic=topic, sequence=0, sent_ns=sent_ns))


# what is printed


@pytest.mark.parametrize(
    ("path", "value"),
    [("speed_mps", 3.0), ("box.x.1", 2.0), ("objects.1.x_m", 9.0), ("objects.5.x_m", None), ("name.more", None)],
)
def test_a_path_names_a_part(path: str, value: object) -> None:
    assert field_of(BODY, path) == value


@pytest.mark.parametrize(
    ("path", "rule"),
    [
        ("nope", "the message has no field 'nope'; its fields are speed_mps"),
        ("box.y", "box has no field 'y'"),
        ("box.x.one", "must be the number of an item"),
        ("speed_mps.x", "is a plain value"),
    ],
)
def test_a_wrong_path_is_named(path: str, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        field_of(BODY, path)


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("speed_mps>2.5", True),
        ("speed_mps <= 2.5", False),
        ("valid==true", True),
        ("valid!=true", False),
        ("objects.0.x_m==1.5", True),
        ("speed_mps==fast", False),
        ("speed_mps<fast", False),
        ("name==null", False),
    ],
)
def test_conditions(text: str, holds: bool) -> None:
    assert parse_condition(text).holds(BODY) is holds


@pytest.mark.parametrize("text", ["", "speed", "speed=3", "__import__('os')>1", ">3"])
def test_a_condition_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected FIELD OPERATOR VALUE"):
        parse_condition(text)


def test_csv_has_the_columns_of_the_first_message() -> None:
    lines = CsvLines()
    first = list(lines.lines({"sequence": 1}, BODY))
    again = list(lines.lines({"sequence": 2}, {**BODY, "name": 'a, "b"', "more": 1}))
    rows = list(csv.reader([*first, *again]))
    assert rows[0] == ["sequence", "speed_mps", "valid", "name", "box.x", "objects"]
    assert rows[1][:4] == ["1", "3.0", "True", ""]
    assert rows[2][3] == 'a, "b"'
    assert {len(row) for row in rows} == {6}


def test_long_lists_are_cut_for_people() -> None:
    lines = list(text_lines({"many": list(range(100)), "objects": [{"x": 1}] * 20}))
    assert lines[0].endswith("... 100 in all]")
    assert len(lines) == 2 + 8


# delays: clock readings are given, so figures are exact


def test_delays_are_those_of_the_stamps() -> None:
    watch = DelayWatch(0)
    for count in range(1, 101):
        sent_ns = count * S
        state = VehicleState(stamp_ns=sent_ns - 2_000_000)
        watch.take(received("vehicle/state", state, sent_ns), sent_ns + count * 10_000)
    rows = {row["delay"]: row for row in watch.rows()}
    assert rows["acquired to sent"]["p50_ms"] == pytest.approx(2.0)
    assert rows["acquired to sent"]["max_ms"] == pytest.approx(2.0)
    assert rows["sent to received"]["messages"] == 100
    assert rows["sent to received"]["p50_ms"] == pytest.approx(0.505)
    assert rows["sent to received"]["max_ms"] == pytest.approx(1.0)
    assert "last beam to received" not in rows


def test_a_view_counts_from_its_last_beam() -> None:
    setup = RadarSetup()
    watch = DelayWatch(0)
    watch.set_up(setup)
    view = msgspec.structs.replace(frame(0), stamp_ns=S)
    sent_ns = S + last_beam_ns(setup) + 30_000_000
    watch.take(received("perception/hidden_objects", view, sent_ns), sent_ns + 1_000_000)
    rows = {row["delay"]: row for row in watch.rows()}
    assert rows["last beam to received"]["p50_ms"] == pytest.approx(31.0)


def test_what_no_clock_here_can_have_stamped_is_said_in_words() -> None:
    watch = DelayWatch(100 * S)
    watch.take(received("vehicle/state", VehicleState(stamp_ns=1_700_000_000 * S), 200 * S), 200 * S)
    watch.take(received("vehicle/state", VehicleState(stamp_ns=0), 200 * S), 200 * S)
    watch.take(received("vehicle/state", VehicleState(stamp_ns=200 * S + 9), 200 * S), 200 * S)
    watch.take(received("vehicle/state", VehicleState(stamp_ns=50 * S), 50 * S), 200 * S)
    rows = {row["delay"]: row for row in watch.rows()}
    assert "2 stamped by another clock" in rows["acquired to sent"]["remark"]
    assert "1 stamped later than they were sent" in rows["acquired to sent"]["remark"]
    assert "1 sent before listening began" in rows["sent to received"]["remark"]
    assert rows["acquired to sent"]["max_ms"] == 0.0


# the verbs


@pytest.mark.parametrize(
    ("words", "rule"),
    [
        (["nope"], "unknown topic 'nope'"),
        (["vehicle/state", "--field", "nope"], "vehicle/state has no such field"),
        (["vehicle/state", "--where", "nope>1"], "vehicle/state has no such field"),
        (["vehicle/state", "--full"], "--full must stand with --json"),
        (["vehicle/state", "--csv", "--json"], "must not be given together"),
        (["vehicle/state", "--npy", "/nowhere/at/all"], "/nowhere/at/all: must be a folder"),
    ],
)
def test_wrong_echoes_are_one_line(words: list[str], rule: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["topic", "echo", *words, "--timeout", "0.1"]) == 2
    error = capsys.readouterr().err
    assert rule in error
    assert error.count("\n") == 1


@pytest.mark.graph
def test_echo_prints_what_was_asked_for(speaker: Callable, capsys: pytest.CaptureFixture[str]) -> None:
    speaker(moving)
    words = ["topic", "echo", "vehicle/state", "--timeout", "20"]
    assert main([*words, "--where", "speed_mps==3", "--count", "2", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [row["message"]["speed_mps"] for row in rows] == [3.0, 3.0]
    assert rows[1]["sequence"] - rows[0]["sequence"] == 4
    assert main([*words, "--field", "speed_mps", "--count", "4"]) == 0
    assert sorted(capsys.readouterr().out.split()) == ["0.0", "1.0", "2.0", "3.0"]
    assert main([*words, "--csv", "--count", "2"]) == 0
    header, *lines = csv.reader(capsys.readouterr().out.splitlines())
    assert header[:4] == ["publisher", "sequence", "sent_ns", "stamp_ns"]
    assert len(lines) == 2
    assert main([*words, "--once", "--where", "speed_mps>9", "--timeout", "0.3"]) == 1
    assert "0 messages in 0.3 s" in capsys.readouterr().err


@pytest.mark.graph
def test_arrays_whole_as_json_and_as_files(
    speaker: Callable, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    speaker(lambda count, now_ns: {"radar/beam": msgspec.structs.replace(BEAM, stamp_ns=now_ns)})
    words = ["topic", "echo", "radar/beam", "--once", "--timeout", "20", "--json"]
    assert main([*words, "--full", "--npy", str(tmp_path)]) == 0
    row = json.loads(capsys.readouterr().out)
    samples = row["message"]["samples"]
    whole = np.frombuffer(base64.b64decode(samples["data"]), samples["dtype"]).reshape(samples["shape"])
    assert np.array_equal(whole, BEAM.samples)
    (path,) = row["arrays"]
    assert np.array_equal(np.load(path, allow_pickle=False), BEAM.samples)
    assert main(words) == 0
    summary = json.loads(capsys.readouterr().out)["message"]["samples"]
    assert (summary["min"], summary["max"], summary["shape"]) == (0, 31, [2, 8, 2])


class Arrivals:
    """A bus on which messages arrive at given times, on a clock that only moves while somebody waits."""

    def __init__(self, arrivals: list[tuple[float, Received]]) -> None:
        self.waiting, self.now_s = arrivals, 0.0
        self.total = 0

    def receive(self, timeout_s: float) -> list[Received]:
        self.now_s += timeout_s
        come = [message for time_s, message in self.waiting if time_s <= self.now_s]
        self.waiting = [each for each in self.waiting if each[0] > self.now_s]
        self.total += len(come)
        return come

    def counts(self) -> tuple[tuple[TopicCount, ...], tuple[TopicCount, ...]]:
        return (TopicCount(topic="vehicle/state", messages=self.total, bytes=100 * self.total, lost=7),), ()

    def close(self) -> None:
        pass


def measured(
    monkeypatch: pytest.MonkeyPatch, arrivals: list[tuple[float, str, int]], duration_s: float
) -> tuple[list[dict], list[dict]]:
    """Rates and volumes of arrivals (time, publisher, sequence)."""
    state = VehicleState(stamp_ns=0)
    bus = Arrivals(
        [
            (at_s, Received("vehicle/state", state, Envelope(publisher=by, topic="t", sequence=count, sent_ns=count)))
            for at_s, by, count in arrivals
        ]
    )
    monkeypatch.setattr(topic_rates, "listen", lambda domain, topics: bus)
    monkeypatch.setattr(topic_rates.time, "monotonic", lambda: bus.now_s)
    return topic_rates.measure(["vehicle/state"], duration_s, "default")


def test_a_message_that_comes_late_is_not_a_flood(monkeypatch: pytest.MonkeyPatch) -> None:
    """One message of 100 bytes, just before the end of 2 s: 50 bytes a second, and not what came in the last 0.1 s."""
    _, (volume,) = measured(monkeypatch, [(2.85, "a", 0)], 2.0)
    assert volume["bytes_per_s"] == pytest.approx(50.0, rel=0.1)


def test_losses_are_those_of_the_publisher_that_lost_them(monkeypatch: pytest.MonkeyPatch) -> None:
    come = [(0.5, "a", 0), (0.6, "a", 1), (0.7, "b", 0), (0.8, "b", 8), (0.9, "a", 2)]
    rates, _ = measured(monkeypatch, come, 1.0)
    assert {row["publisher"]: row["lost"] for row in rates} == {"a": 0, "b": 7}


@pytest.mark.graph
def test_delay_info_and_rates_of_a_living_topic(speaker: Callable, capsys: pytest.CaptureFixture[str]) -> None:
    def messages(count: int, now_ns: int) -> dict[str, msgspec.Struct]:
        counts = (TopicCount(topic="vehicle/state", messages=count, bytes=9 * count, lost=1),)
        beat = example_status(stamp_ns=now_ns, node="speaker", uptime_s=0.02 * count, received=counts)
        return {**moving(count, now_ns), "diagnostics/node": beat}

    speaker(messages)
    assert main(["topic", "delay", "vehicle/state", "--duration", "0.6", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {row["topic"] for row in found} == {"vehicle/state"}
    rows = {row["delay"]: row for row in found}
    assert rows["acquired to sent"]["p50_ms"] >= 5.0
    assert rows["sent to received"]["p50_ms"] >= 0.0
    assert main(["topic", "delay", "--duration", "0.6"]) == 0
    shown = capsys.readouterr().out
    assert "speaker" in shown.split()
    assert "REMARK" not in shown, "figures alone: remarks are lines below"
    assert main(["topic", "info", "vehicle/state", "--duration", "0.6", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["type"], found["fields"]["speed_mps"]) == ("VehicleState", "float")
    assert [row["node"] for row in found["publishers"]] == ["speaker"]
    assert [(row["node"], row["lost"]) for row in found["readers"]] == [("speaker", 1)]
    for verb in ("hz", "bw"):
        # from the first message on, for which they wait a second more
        assert main(["topic", verb, "vehicle/state", "--duration", "0.2", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)[0]["messages"] > 0


@pytest.mark.graph
def test_a_foreign_topic_is_shown_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a type that nobody here knows, with garbage between; hz and bw count it as well."""
    folder = run_dir("default")
    folder.mkdir()
    ended = threading.Event()
    cloud = np.arange(6, dtype="<f4").reshape(2, 3)

    def speak() -> None:
        with zmq.Context() as context, context.socket(zmq.PUB) as publisher:
            publisher.linger = 0
            publisher.bind(f"ipc://{folder / 'lidar.cloud@lidar'}")
            count = 0
            while not ended.wait(0.02):
                envelope = Envelope(publisher="lidar", topic="lidar/cloud", sequence=count, sent_ns=20_000_000 * count)
                body = {"name": "front", "cloud": {"dtype": "<f4", "shape": [2, 3], "frame": 0}}
                head = msgspec.msgpack.encode({"envelope": envelope, "body": body})
                publisher.send_multipart([b"lidar/cloud\0", head, cloud.tobytes()])
                publisher.send_multipart([b"lidar/cloud\0", b"\xc1"])
                count += 1

    thread = threading.Thread(target=speak)
    thread.start()
    try:
        while not (folder / "lidar.cloud@lidar").exists():
            assert thread.is_alive()
        assert main(["topic", "list", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)[-1] == {
            "topic": "lidar.cloud", "type": "foreign", "rate_hz": 0.0, "publishers": ["lidar"],
        }  # fmt: skip
        words = ["topic", "echo", "lidar/cloud", "--once", "--timeout", "20", "--npy", str(tmp_path), "--json"]
        assert main([*words, "--where", "name==front"]) == 0
        row = json.loads(capsys.readouterr().out)
        assert row["message"]["cloud"] == {"dtype": "<f4", "shape": [2, 3], "min": 0.0, "max": 5.0, "mean": 2.5}
        assert np.array_equal(np.load(row["arrays"][0], allow_pickle=False), cloud)
        assert main(["topic", "bw", "lidar.cloud", "--duration", "0.5", "--json"]) == 0
        (volume,) = json.loads(capsys.readouterr().out)
        assert volume["messages"] > 0
        assert volume["rejected"] > 0
        assert main(["topic", "hz", "lidar/cloud", "--duration", "0.2", "--json"]) == 0
        (rate,) = json.loads(capsys.readouterr().out)
        assert (rate["topic"], rate["publisher"], rate["lost"]) == ("lidar/cloud", "lidar", 0)
        assert rate["rate_hz"] == pytest.approx(50.0)
    finally:
        ended.set()
        thread.join()


@pytest.mark.parametrize(
    "body",
    [
        {"a": {"dtype": "<f4", "shape": [2], "frame": 1}},
        {"a": {"dtype": "<f4", "shape": [3], "frame": 0}},
        {"a": {"dtype": "O", "shape": [1], "frame": 0}},
        {"a": {"dtype": "<f4", "shape": [-2], "frame": 0}},
        {"a": {"dtype": "<f4", "shape": "two", "frame": 0}},
        [1, 2],
    ],
)
def test_a_foreign_message_that_is_none_is_refused(body: object) -> None:
    envelope = Envelope(publisher="a", topic="t", sequence=0, sent_ns=0)
    head = msgspec.msgpack.encode({"envelope": envelope, "body": body})
    with pytest.raises(ValueError, match=r"^t: "):
        decode_foreign("t", [memoryview(b"t\0"), memoryview(head), memoryview(bytes(8))])


NO_GRAPH = "mirrorwave: no graph runs in domain 'default': start one with `mirrorwave launch FILE` or `mirrorwave demo`"


@pytest.mark.parametrize(
    "words",
    [
        ["topic", "echo", "vehicle/state", "--timeout", "0.2"],
        # without a limit it waits for a graph to come, and no longer
        ["topic", "echo", "vehicle/state"],
        ["topic", "hz", "vehicle/state", "--duration", "0.2"],
        ["topic", "bw", "vehicle/state", "--duration", "0.2"],
        ["topic", "delay", "--duration", "0.2"],
        ["node", "list", "--window", "0.2"],
        ["node", "info", "player", "--window", "0.2"],
        ["graph", "--window", "0.6"],
        ["top"],
        ["top", "--once", "--window", "0.5"],
        ["param", "set", "ra_former", "mode=welch"],
        ["bag", "snapshot"],
        ["bag", "record", "x.mcap", "--duration", "0.2"],
    ],
)
def test_without_a_graph_one_line_says_so(
    words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("mirrorwave.diagnose.running_graph.FIND_S", 0.2)
    monkeypatch.setattr("mirrorwave.diagnose.topic_rates.FIND_S", 0.2)
    monkeypatch.chdir(tmp_path)
    assert main(words) == 1
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", f"{NO_GRAPH}\n")
    assert not list(tmp_path.iterdir())


def test_tables_of_the_contract_stand_without_a_graph(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["topic", "info", "vehicle/state", "--duration", "0.2"]) == 0
    said = capsys.readouterr().out
    assert "speed_mps" in said
    assert NO_GRAPH.removeprefix("mirrorwave: ") in said


@pytest.mark.graph
def test_silence_on_a_running_graph_says_whose_it_is(
    speaker: Callable[[Any], None], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    speaker(lambda count, now_ns: {"vehicle/state": VehicleState(stamp_ns=now_ns)})
    assert main(["topic", "echo", "vehicle/state", "--once"]) == 0
    monkeypatch.setattr("mirrorwave.diagnose.running_graph.FIND_S", 0.2)
    capsys.readouterr()
    nobody = "nothing came on radar/beam in 0.2 s; nobody publishes radar/beam"
    for words in (["hz", "radar/beam", "--duration", "0.2"], ["echo", "radar/beam", "--timeout", "0.2"]):
        assert main(["topic", *words, "--json"]) == 1
        assert capsys.readouterr().err == f"mirrorwave: {nobody}\n"
    assert main(["topic", "hz", "vehicle/state", "--duration", "0.2", "--domain", "nobody_is_here"]) == 1
    assert "one runs in --domain " in capsys.readouterr().err
    assert main(["topic", "echo", "vehicle/state", "--where", "speed_mps<-1", "--timeout", "1"]) == 1
    assert "vehicle/state: 0 messages in 1 s, " in (error := capsys.readouterr().err)
    assert error.endswith(" did not pass --where\n")


# publishing


def test_pub_reaches_a_reader_and_says_how_many(
    speaker: Callable[..., None], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Three messages at 50 Hz from a file: in order, stamped with the time of each."""
    speaker(moving)
    bus = ZmqBus("reader", run_dir("default"))
    try:
        bus.subscribe("log")
        fields = tmp_path / "line.yaml"
        fields.write_text("{node: me, level: info, text: hello}")
        received: list[Received] = []
        sender = threading.Thread(
            target=main, args=(["topic", "pub", "log", "--file", str(fields), "--count", "3", "--rate", "50"],)
        )
        sender.start()
        while sender.is_alive() or len(received) < 3:
            received += bus.receive(0.05)
        sender.join()
    finally:
        bus.close()
    lines: list[Any] = [item.message for item in received]
    assert [(line.node, line.text) for line in lines] == [("me", "hello")] * 3
    assert [item.envelope.sequence for item in received] == [0, 1, 2]
    assert lines[0].stamp_ns < lines[1].stamp_ns < lines[2].stamp_ns
    assert capsys.readouterr().out == "log: 3 messages to 1 reader\n"


def test_pub_without_a_reader_ends_with_code_3(
    speaker: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    speaker(moving)
    assert main(["topic", "pub", "vehicle/state", "{speed_mps: 3}"]) == 3
    assert capsys.readouterr().out == "vehicle/state: 1 message to 0 readers\n"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["vehicle/state"], "topic pub takes VALUE or --file, one of them"),
        (["vehicle/state", "[1]"], "VALUE must be a mapping of fields"),
        (["vehicle/state", "{speed: 3}"], "vehicle/state: unknown field 'speed'; known are"),
        (["vehicle/state", "{speed_mps: 3"], "VALUE: line 1"),
        (["nope", "{}"], "unknown topic 'nope'"),
    ],
)
def test_pub_refuses_before_it_opens_anything(words: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["topic", "pub", *words]) == 2
    error = capsys.readouterr().err
    assert line in error
    assert error.count("\n") == 1
