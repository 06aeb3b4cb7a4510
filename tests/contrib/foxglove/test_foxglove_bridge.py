"""The Foxglove bridge from outside: a client of its own reads every channel; who may not come in gets nothing."""

from __future__ import annotations

import base64
import contextlib
import json
import re
import struct
import time
from collections.abc import Iterator
from typing import Any

import jsonschema
import msgspec
import numpy as np
import pytest
import yaml
from websockets.exceptions import ConnectionClosed, InvalidStatus, NegotiationError
from websockets.sync.client import ClientConnection, connect

from contrib.foxglove.foxglove_bridge import FoxgloveBridge, Params, create
from contrib.foxglove.foxglove_messages import MAX_PRIMITIVES, FoxgloveStream
from contrib.foxglove.foxglove_schemas import CHANNELS, SCHEMAS
from contrib.foxglove.foxglove_server import MAX_CLIENT_MESSAGES_PER_S
from msgs.bus.interface import Envelope, Received
from msgs.bus.topics import TOPICS, Topic
from msgs.files.shipped import CHECKOUT
from msgs.values.camera import CameraImage
from msgs.values.diagnostics import LogRecord, NodeState, StageTime
from msgs.values.perception import BevFrame
from msgs.values.radar import RadarSetup
from msgs.values.vehicle import VehicleState
from tests.builders import example_object, example_status, example_track
from tests.fuzz.cases import peaks, ra_map, view
from tests.mirrorwave.convert.test_formats import truth
from tests.side_sensors import cloud, jpeg

SUBPROTOCOL = "foxglove.sdk.v1"
PATIENCE_S = 30.0
NOW_NS = 5_000_000_000
HIDDEN = example_object(id=1, x_m=3.0, y_m=1.0, score=0.5)
TRACK = example_track(velocity_x_mps=3.0, velocity_y_mps=4.0)


@pytest.fixture
def bridge() -> Iterator[FoxgloveBridge]:
    node = create(Params(port=0, allowed_origins=("https://app.foxglove.dev",)))
    node.server._max_clients = 2
    yield node
    node.close()


def received(message: Any, topic: str = "log") -> Received:
    return Received(topic, message, Envelope(publisher="test", topic=topic, sequence=0, sent_ns=0))


def messages() -> list[Any]:
    """One of each that becomes something; two heartbeats, since cores come from their difference."""
    beat = example_status(
        stamp_ns=1,
        uptime_s=1.0,
        cpu_s=0.1,
        stages=(StageTime(name="fold", count=1, last_ms=1.0, mean_ms=1.0, max_ms=1.0),),
    )
    return [
        RadarSetup(),
        view(1, 10),
        ra_map(1, 10),
        peaks(1, 10),
        truth(1),
        VehicleState(stamp_ns=20, speed_mps=3.0),
        VehicleState(stamp_ns=30_000_000, speed_mps=3.0),
        beat,
        msgspec.structs.replace(beat, uptime_s=2.0, cpu_s=0.6),
        LogRecord(stamp_ns=40, node="geometry", level="error", text="lost"),
        cloud(stamp_ns=50),
        CameraImage.of(jpeg(), stamp_ns=60),
    ]


class Client:
    """Reads by the protocol's rules alone: what a channel is and how it is encoded comes from its announcement."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket = socket
        self.info = json.loads(socket.recv(PATIENCE_S))
        announced = json.loads(socket.recv(PATIENCE_S))
        assert announced["op"] == "advertise"
        self.channels = {channel["id"]: channel for channel in announced["channels"]}
        self.subscriptions: dict[int, dict[str, Any]] = {}

    def subscribe(self) -> None:
        self.subscriptions = {100 + number: channel for number, channel in self.channels.items()}
        wanted = [{"id": own, "channelId": channel["id"]} for own, channel in self.subscriptions.items()]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def message(self) -> tuple[str, dict[str, Any]]:
        """Topic and body of the next message, held against the schema of its announcement."""
        data = self.socket.recv(PATIENCE_S)
        assert isinstance(data, bytes), data
        opcode, subscription, at_ns = struct.unpack_from("<BIQ", data)
        assert (opcode, at_ns) == (1, NOW_NS)
        channel = self.subscriptions[subscription]
        assert (channel["encoding"], channel["schemaEncoding"]) == ("json", "jsonschema")
        body = json.loads(data[13:], parse_constant=pytest.fail)
        jsonschema.validate(body, json.loads(channel["schema"]))
        return channel["topic"], body


def client_of(bridge: FoxgloveBridge, **options: Any) -> ClientConnection:
    return connect(bridge.server.url, subprotocols=[SUBPROTOCOL], **options)  # type: ignore[list-item]


def until_wanted(bridge: FoxgloveBridge, topics: set[str]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while bridge.server.wanted != topics:
        assert time.monotonic() < end_s, bridge.server.wanted
        time.sleep(0.01)


def test_a_client_of_another_make_decodes_every_channel(bridge: FoxgloveBridge) -> None:
    with client_of(bridge) as socket:
        client = Client(socket)
        assert socket.subprotocol == SUBPROTOCOL
        assert client.info["capabilities"] == []
        assert {channel["topic"]: channel["schemaName"] for channel in client.channels.values()} == CHANNELS
        client.subscribe()
        until_wanted(bridge, set(CHANNELS))
        bridge.step([received(message) for message in messages()], NOW_NS)
        bodies: dict[str, dict[str, Any]] = {}
        while set(bodies) != set(CHANNELS):
            topic, body = client.message()
            bodies[topic] = body
    image = bodies["/radar/ra_map"]
    assert len(base64.b64decode(image["data"])) == image["height"] * image["step"]
    found = bodies["/radar/peaks"]
    assert len(base64.b64decode(found["data"])) == found["point_stride"] * len(peaks(1, 10))
    assert base64.b64decode(bodies["/lidar/points"]["data"]) == cloud().data.tobytes()
    assert base64.b64decode(bodies["/camera/image"]["data"]) == jpeg()


class Door(msgspec.Struct):
    """A message of somebody else."""

    stamp_ns: int
    angles_rad: np.ndarray


def test_a_topic_of_other_people_is_a_channel_of_its_name() -> None:
    with TOPICS.restored():
        for name in ("my/door", "views"):
            TOPICS.declare(Topic(name=name, type=Door), "test")
        node = create(Params(port=0))
        try:
            assert node.inputs[-2:] == ("my/door", "views")
            with client_of(node) as socket:
                client = Client(socket)
                client.subscribe()
                until_wanted(node, {*CHANNELS, "/my/door", "/topics/views"})
                door = Door(40, np.array([[0.5, 1.0]]))
                node.step([received(door, "my/door"), received(door, "views")], NOW_NS)
                bodies = dict(client.message() for _ in range(2))
        finally:
            node.close()
    assert bodies.keys() == {"/my/door", "/topics/views"}
    assert bodies["/my/door"]["timestamp"] == {"sec": 0, "nsec": 40}
    assert bodies["/my/door"]["angles_rad"]["shape"] == [1, 2]
    assert bodies["/my/door"]["angles_rad"]["values"] == [0.5, 1.0]


def test_nothing_is_encoded_that_nobody_reads(bridge: FoxgloveBridge) -> None:
    bridge.step([received(message) for message in messages()], NOW_NS)
    assert not bridge.stages.drain()
    assert bridge.health()[0] is NodeState.READY


def test_nobody_gets_in_without_token_or_from_a_foreign_page(bridge: FoxgloveBridge) -> None:
    """0 of N: each attempt ends with its refusal, and not one byte of the graph is sent."""
    host, _, token = bridge.server.url.removeprefix("ws://").partition("/")
    wrong = ("", "x", token[:-1], token + "x", token.swapcase(), "../" + token, "%00" + token, "x/" + token)
    foreign = ("https://evil.example", "null", "http://127.0.0.1", "https://app.foxglove.dev.evil.example", "file://x")
    attempts: list[tuple[str, dict[str, Any]]] = [(f"ws://{host}/{path}", {}) for path in wrong]
    attempts += [(bridge.server.url, {"origin": origin}) for origin in foreign]
    attempts += [(bridge.server.url, {"additional_headers": {"Host": name}}) for name in ("evil.example", "0.0.0.0")]
    let_in = 0
    for address, options in attempts * 3:
        with pytest.raises(InvalidStatus) as refused:
            connect(address, subprotocols=[SUBPROTOCOL], **options)  # type: ignore[list-item]
        assert refused.value.response.status_code in (400, 403, 404)
        assert token.encode() not in (refused.value.response.body or b"")
        let_in += bridge.server.clients
    assert (len(attempts * 3), let_in) == (45, 0)
    with client_of(bridge, origin="https://app.foxglove.dev") as socket:
        assert Client(socket).info["op"] == "serverInfo"


def test_a_client_without_the_protocol_is_refused(bridge: FoxgloveBridge) -> None:
    with pytest.raises((InvalidStatus, NegotiationError)) as refused:
        connect(bridge.server.url, subprotocols=["mqtt"])  # type: ignore[list-item]
    assert "subprotocol" in str(getattr(refused.value, "response", refused.value).body)


BROKEN: list[str | bytes] = ["", "x", "[]", "{}", '{"op": 1}', '{"op": "subscribe"}', b"\x01\x00", "[" * 8000]
BROKEN += [f'{{"op": "subscribe", "subscriptions": [{body}]}}' for body in ('{"id": -1}', '{"id": -1, "channelId": 1}')]


@pytest.mark.parametrize("message", BROKEN)
def test_a_client_that_breaks_the_protocol_is_let_go(bridge: FoxgloveBridge, message: str | bytes) -> None:
    with client_of(bridge) as socket:
        Client(socket)
        socket.send(message)
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv(PATIENCE_S)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1008
    assert bridge.server.alive


def test_what_is_not_served_is_said_and_harms_nothing(bridge: FoxgloveBridge) -> None:
    with client_of(bridge) as socket:
        Client(socket)
        socket.send('{"op": "setParameters", "parameters": []}')
        assert "'setParameters' is not served here" in json.loads(socket.recv(PATIENCE_S))["message"]
        socket.send('{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 999}]}')
        assert json.loads(socket.recv(PATIENCE_S))["message"] == "no channel 999"
        for _ in range(2):
            socket.send('{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1}]}')
        assert "already subscribed" in json.loads(socket.recv(PATIENCE_S))["message"]
        socket.send('{"op": "unsubscribe", "subscriptionIds": [1]}')
        until_wanted(bridge, set())


def test_a_flood_and_one_too_many_are_let_go(bridge: FoxgloveBridge) -> None:
    with client_of(bridge) as first, client_of(bridge) as second:
        Client(first), Client(second)
        with client_of(bridge) as third, pytest.raises(ConnectionClosed, match="at most 2 may look at once"):
            third.recv(PATIENCE_S)
        with contextlib.suppress(ConnectionClosed):
            for _ in range(3 * MAX_CLIENT_MESSAGES_PER_S):
                first.send('{"op": "unsubscribe", "subscriptionIds": []}')
        with pytest.raises(ConnectionClosed, match="messages a second"):
            first.recv(PATIENCE_S)


def test_a_token_of_the_same_run_is_kept(tmp_path: Any) -> None:
    """A bridge that is restarted is found again by its clients."""
    file = str(tmp_path / "foxglove.token")
    urls = []
    for _ in range(2):
        node = create(Params(port=0, token_file=file))
        urls.append(node.server.url)
        node.close()
    assert len({url.rpartition("/")[2] for url in urls}) <= 2


@pytest.mark.parametrize(
    ("params", "rule"),
    [
        ({"port": 70_000}, "port must be 0..65535"),
        ({"allowed_origins": ("*",)}, "allowed_origins must be scheme://host:port"),
        ({"allowed_origins": ("https://a/b",)}, "without a path"),
        ({"allowed_origins": ("null",)}, "allowed_origins must be"),
    ],
)
def test_wrong_parameters_are_refused(params: dict[str, Any], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        Params(**params)


# messages


def bodies(*items: Any) -> dict[str, dict[str, Any]]:
    """The last body of each topic, held against its schema, through strict JSON."""
    stream, last = FoxgloveStream(), {}
    for item in items:
        for draft in stream.drafts(item, NOW_NS):
            text = msgspec.json.encode(draft.build())
            body = json.loads(text, parse_constant=pytest.fail)
            jsonschema.validate(body, SCHEMAS[CHANNELS[draft.topic]])
            last[draft.topic] = body
    return last


def test_a_map_of_nothing_and_one_of_one_cell_are_drawn() -> None:
    empty = ra_map(1, 10)
    values = np.zeros_like(empty.values)
    single = values.copy()
    single[1, 1] = 1.0
    for cells in (values, single):
        said = bodies(msgspec.structs.replace(empty, values=cells))
        assert len(base64.b64decode(said["/radar/ra_map"]["data"])) == cells.size


def test_a_flood_of_objects_is_cut_and_counted() -> None:
    frame: BevFrame = msgspec.structs.replace(view(1, 10), objects=(HIDDEN,) * (MAX_PRIMITIVES + 5))
    entities = {entity["id"]: entity for entity in bodies(frame)["/hidden_objects/scene"]["entities"]}
    assert len(entities["objects"]["cubes"]) == MAX_PRIMITIVES
    assert {"key": "cubes left out", "value": "5"} in entities["objects"]["metadata"]


# what ships


def test_the_layout_shows_topics_that_there_are() -> None:
    text = (CHECKOUT / "launch/foxglove_layout.json").read_text(encoding="utf-8")
    layout = json.loads(text)
    assert layout["configById"]
    named = set(re.findall(r'"(/[a-z_/]+)', text))
    assert named
    assert named <= set(CHANNELS), named - set(CHANNELS)


def test_the_launch_file_runs_the_bridge_as_a_viewer() -> None:
    nodes = yaml.safe_load((CHECKOUT / "launch/corner_foxglove.yaml").read_text(encoding="utf-8"))["nodes"]
    assert nodes["foxglove"] == {"module": "contrib.foxglove.foxglove_bridge", "viewer": True}
