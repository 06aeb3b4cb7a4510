"""Topics of other people: declared by packages and launch files, carried like the shipped ones, refused in one line."""

from __future__ import annotations

import enum
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import jsonschema
import msgspec
import numpy as np
import pytest

from contrib.foxglove.foxglove_messages import FoxgloveStream
from contrib.foxglove.foxglove_schemas import channels
from mirrorwave.cli import main
from mirrorwave.control import launch_params
from msgs.bus.codec import encode_inline
from msgs.bus.declared import NAME, expect_declared, write_declared
from msgs.bus.local import LocalNetwork
from msgs.bus.message_types import refusal_of
from msgs.bus.topics import SHIPPED, TOPICS, Declaration, Topic, topic_facts
from msgs.files.plugins import TOPICS as GROUP
from msgs.recording.mcap import RecordingReader, RecordingWriter
from msgs.values.arrays import Array, Checked
from nodes.process.launch_file import launch_from_mapping
from tests.plugins import write_package

HEAD = """
import msgspec
from msgs.bus.topics import Topic
class Door(msgspec.Struct):
    open_deg: float
class Gate(msgspec.Struct):
    height_m: float
class Empty(msgspec.Struct):
    pass
class Strange(msgspec.Struct):
    parts: list[object]
class Row(msgspec.Struct, array_like=True):
    x: int
class Plain:
    x: int
"""
NODES = {"recorder": {"module": "nodes.recorder", "params": {"path": "x"}}}


@pytest.fixture(autouse=True)
def _other_people() -> Iterator[None]:
    """Packages are asked again, and what a test declares ends with it."""
    with TOPICS.restored():
        TOPICS._has_asked = False
        yield


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Write a package that declares topics, and make it importable."""

    def write(name: str, source: str, **modules: str) -> None:
        folder = write_package(tmp_path / name, name, GROUP, {name: f"{name}_topics"}, **{f"{name}_topics": source})
        monkeypatch.syspath_prepend(folder)
        monkeypatch.delitem(sys.modules, f"{name}_topics", raising=False)

    return write


class Corner(msgspec.Struct):
    place_m: tuple[float, float]
    outline_m: np.ndarray


class Mood(enum.Enum):
    CALM = "calm"


class Everything(Checked, frozen=True, kw_only=True):
    """What a message may hold."""

    label = "everything"
    stamp_ns: int
    angles_rad: Annotated[np.ndarray, Array("<f4", (None,), -10.0, 10.0)]
    spectrum: np.ndarray
    corners: list[Corner]
    counts: dict[str, int]
    mood: Mood = Mood.CALM
    note: str | None = None
    range_m: float = float("nan")
    raw: bytes = b""


def everything(stamp_ns: int = 1) -> Everything:
    return Everything(
        stamp_ns=stamp_ns,
        angles_rad=np.array([1.0, -2.0], np.float32),
        spectrum=np.array([[1j, 2.0]], np.complex64),
        corners=[Corner((1.0, 2.0), np.array([[True, False]]))],
        counts={"a": 1},
        raw=b"ab",
    )


def test_a_message_of_any_content_comes_through_bus_recording_and_foxglove(tmp_path: Path) -> None:
    TOPICS.declare(Topic(name="my/all", type=Everything, rate_hz=5.0), "test")
    assert list(TOPICS) == [*SHIPPED, "my/all"]
    assert list(TOPICS.own()) == ["my/all"]
    network = LocalNetwork()
    sender, receiver = network.bus("a"), network.bus("b")
    receiver.subscribe("my/all")
    sender.publish("my/all", everything())
    (received,) = receiver.receive(0.0)
    assert encode_inline(received.message) == encode_inline(everything())
    path = tmp_path / "own.mcap"
    with RecordingWriter(path, {}) as writer:
        writer.write("my/all", received.message, publisher="a", sequence=0, sent_ns=7)
    with RecordingReader(path) as reader:
        (recorded,) = reader.messages()
        assert reader.types == {"my/all": "Everything"}
        assert reader.info().topics[0].known
        (schema,) = reader._schemas.values()
        assert set(json.loads(schema.data)["$defs"]["Everything"]["properties"]) == set(Everything.__struct_fields__)
    assert encode_inline(recorded.message) == encode_inline(everything())
    (draft,) = FoxgloveStream().drafts_of("my/all", recorded.message, 7)
    body = json.loads(msgspec.json.encode(draft.build()))
    jsonschema.validate(body, channels()[draft.topic])
    assert (draft.topic, body["timestamp"]) == ("/my/all", {"sec": 0, "nsec": 1})
    assert body["angles_rad"]["values"] == [1.0, -2.0]
    assert body["corners"][0]["outline_m"]["values"] == [1, 0]
    # a number that is none, a text that is not there, values that are no plain numbers
    assert not {"range_m", "note"} & body.keys()
    assert "values" not in body["spectrum"]


def test_a_package_is_asked_when_a_name_is_not_known(package: Any) -> None:
    package("doors", HEAD + "TOPICS = (Topic(name='my/door', type=Door, max_bytes=4096, latched=True),)")
    assert topic_facts("radar/beam").name == "radar/beam"
    assert "doors_topics" not in sys.modules
    facts = topic_facts("my/door")
    assert (facts.type.__name__, facts.max_bytes, facts.latched) == ("Door", 4096, True)
    assert TOPICS.origin("my/door") == "doors of doors 1.2"


#: What is wrong, the topic's name and facts in a declaration, its type, and the line about it.
BAD = [
    pytest.param("My Door", "Door", {}, r"a name must be words of a-z, 0-9 and _, joined by /.*", id="a name"),
    pytest.param("my.door", "Door", {}, r"a name must be words of .*", id="a dot"),
    pytest.param("my/door", "Plain", {}, "type must be a msgspec Struct, got Plain", id="no Struct"),
    pytest.param("my/door", "HEIGHT", {}, "type must be a msgspec Struct, got int", id="no type"),
    pytest.param("my/door", "Empty", {}, "type must have a field to encode, but Empty has none", id="no field"),
    pytest.param("my/door", "Strange", {}, ".*but Strange.parts is object", id="a field without a form"),
    pytest.param("my/door", "Row", {}, "type must name its fields on the wire, but Row is array_like", id="a row"),
    pytest.param("my/door", "Door", {"max_bytes": 3}, r"max_bytes must be 1024\.\..*, got 3", id="a limit"),
    pytest.param("my/door", "Door", {"history_bytes": 1024}, r"history_bytes must be 1048576\.\..*", id="a queue"),
    pytest.param("my/door", "Door", {"rate_hz": -1.0}, r"rate_hz must be 0\.\..*, got -1\.0", id="a rate"),
    pytest.param("my/door", "Door", {"latched": 1}, r"latched must be true or false|latched: Expected bool", id="flag"),
    pytest.param(
        "radar/beam", "Door", {}, "declared twice with two types, .*Door here and .*RadarBeam by mirrorwave", id="taken"
    ),
]


@pytest.mark.parametrize(("name", "kind", "facts", "rule"), BAD)
def test_a_bad_declaration_of_a_package_is_one_line(
    name: str, kind: str, facts: dict[str, Any], rule: str, package: Any
) -> None:
    package("bad", f"{HEAD}HEIGHT = 3\nTOPICS = (Topic(name={name!r}, type={kind}, **{facts}),)")
    assert list(TOPICS) == list(SHIPPED)
    (line,) = TOPICS.refused.values()
    with pytest.raises(ValueError, match=rule) as refused:
        raise ValueError(line)
    assert str(refused.value).startswith(f"bad of bad 1.2: topic {name!r}: ")
    if name not in SHIPPED:
        with pytest.raises(ValueError, match=r"^unknown topic .*: bad of bad 1\.2"):
            topic_facts(name)


@pytest.mark.parametrize(("name", "kind", "facts", "rule"), BAD)
def test_a_bad_declaration_of_a_launch_file_is_the_same_line(
    name: str, kind: str, facts: dict[str, Any], rule: str, package: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    package("bad", f"{HEAD}HEIGHT = 3\nTOPICS = (Topic(name='x/y', type=Door),)")
    declared = {name: {"type": f"bad_topics.{kind}", **facts}}
    with pytest.raises(ValueError, match=f"my.yaml: .*{rule}"):
        require_good(declared, capsys)


@pytest.mark.parametrize(
    ("kind", "rule"),
    [
        ("nowhere.Door", "type nowhere.Door: no module named 'nowhere'"),
        ("bad_topics.Window", "type bad_topics.Window: bad_topics defines no Window"),
        ("Door", r"type must be package\.module\.Class, got 'Door'"),
        (3, "Expected str, got int"),
    ],
)
def test_a_type_that_cannot_be_imported_is_one_line(
    kind: Any, rule: str, package: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    package("bad", HEAD + "TOPICS = (Topic(name='x/y', type=Door),)")
    with pytest.raises(ValueError, match=f"my.yaml: .*{rule}"):
        require_good({"my/door": {"type": kind}}, capsys)


def test_a_launch_file_and_a_package_must_agree(package: Any, capsys: pytest.CaptureFixture[str]) -> None:
    package("doors", HEAD + "TOPICS = (Topic(name='my/door', type=Door),)")
    require_good({"my/door": {"type": "doors_topics.Door"}}, capsys)
    rule = r"declared twice with two types, doors_topics\.Gate here and doors_topics\.Door by doors of doors 1\.2"
    with pytest.raises(ValueError, match=rf"^my\.yaml: topic 'my/door': {rule}$"):
        require_good({"my/door": {"type": "doors_topics.Gate"}}, capsys)
    with pytest.raises(ValueError, match=r"^my\.yaml: topic 'my/door': declared twice, rate_hz 9.0 here and 0.0 by "):
        require_good({"my/door": {"type": "doors_topics.Door", "rate_hz": 9.0}}, capsys)


def require_good(topics: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    """Do what a launch does with the topics of its file before it starts."""
    launch = launch_from_mapping({"name": "a", "nodes": NODES, "topics": topics}, "my.yaml")
    asked = {"nodes": {}, "topics": msgspec.to_builtins(launch.topics), "where": "my.yaml"}
    with TOPICS.restored():
        launch_params.main([json.dumps(asked)])
    for reason in json.loads(capsys.readouterr().out.splitlines()[-1]).values():
        raise ValueError(reason)


def test_two_packages_that_disagree_lose_the_topic_both(
    package: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    package("doors", HEAD + "TOPICS = (Topic(name='my/door', type=Door), Topic(name='my/gate', type=Gate))")
    package("zoo", HEAD + "TOPICS = (Topic(name='my/door', type=Gate),)")
    assert list(TOPICS.own()) == ["my/gate"]
    with pytest.raises(ValueError, match=r"zoo of zoo .*zoo_topics.Gate here and doors_topics.Door by doors of doors"):
        topic_facts("my/door")
    monkeypatch.setenv("MIRRORWAVE_RUN_DIR", str(tmp_path / "run"))
    assert main(["topic", "list", "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)[-1]["topic"] == "my/gate"
    assert said.err == f"left out: {TOPICS.refused['my/door']}\n"


@pytest.mark.parametrize(
    ("source", "line"),
    [
        ("x = 1", "bad of bad 1.2: bad_topics must define TOPICS"),
        ("TOPICS = 3", "bad of bad 1.2: TOPICS of bad_topics must be a tuple of Topic, got int"),
        ("TOPICS = (3,)", "bad of bad 1.2: TOPICS of bad_topics must be a tuple of Topic, got tuple"),
        ("import nowhere", "bad of bad 1.2: bad_topics needs nowhere, which is not installed"),
        ("1 / 0", r"bad of bad 1.2: bad_topics cannot be imported: ZeroDivisionError: .*bad_topics.py:1\)"),
    ],
)
def test_a_module_without_topics_is_one_line_where_a_name_is_unknown(source: str, line: str, package: Any) -> None:
    package("bad", source)
    with pytest.raises(ValueError, match=f"^unknown topic 'my/door'; known are .*; {line}$"):
        topic_facts("my/door")
    assert topic_facts("log").name == "log"


def test_all_who_meet_in_a_run_directory_know_the_topics_of_its_graph(package: Any, tmp_path: Path) -> None:
    package("doors", HEAD)
    write_declared(tmp_path, {"my/door": Declaration(type="doors_topics.Door", rate_hz=2.0)}, "graph")
    expect_declared(tmp_path)
    assert topic_facts("my/door").rate_hz == 2.0
    write_declared(tmp_path, {}, "graph")
    assert not (tmp_path / NAME).exists()


def test_a_file_that_others_may_write_imports_nothing(tmp_path: Path) -> None:
    write_declared(tmp_path, {"my/door": Declaration(type="antigravity.Door")}, "graph")
    (tmp_path / NAME).chmod(0o666)
    expect_declared(tmp_path)
    (tmp_path / NAME).chmod(0o600)
    (tmp_path / NAME).write_text("{")
    expect_declared(tmp_path)
    assert "my/door" not in TOPICS
    assert "antigravity" not in sys.modules


def test_every_shipped_type_keeps_the_rule() -> None:
    assert [name for name in SHIPPED if refusal_of(TOPICS[name].type)] == []
