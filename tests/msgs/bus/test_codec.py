"""The codec: round trips of every topic's type, the wire as another library sees it, and refusals."""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Callable

import jsonschema
import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msgs.bus import codec
from msgs.bus.codec import CodecError, decode, decode_inline, encode, encode_inline, json_schema, to_builtins
from msgs.bus.interface import Envelope
from msgs.bus.topics import TOPICS
from msgs.values.arrays import DTYPES, MAX_SPEED_MPS, MAX_STAMP_NS
from msgs.values.camera import CameraImage
from msgs.values.detections import RadarDetections
from msgs.values.diagnostics import LogRecord, NodeState, NodeStatus, ShedCount, StageTime, TopicCount
from msgs.values.environment import GnssPose, PriorWall, WallPriors
from msgs.values.lidar import LidarSetup, PhotonHistograms, SpadParams
from msgs.values.node_params import NodeParams, ParamRequest
from msgs.values.perception import BevFrame, HiddenPoint, Peaks, SceneTruth, TruthObject, Wall
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthGrid
from msgs.values.vehicle import VehicleState
from tests.builders import example_map, example_object, example_status, example_track, peaks_at
from tests.side_sensors import cloud, jpeg

RANDOM = np.random.default_rng(7)
GRID = RangeAzimuthGrid(range_bins=6, azimuth_bins=4)


def beam(**changes: object) -> RadarBeam:
    fields: dict[str, object] = {
        "stamp_ns": 5,
        "scan_id": 2,
        "beam_index": 1,
        "beam_count": 3,
        "azimuth_rad": 0.1,
        "samples": RANDOM.integers(-99, 99, (2, 8, 2), dtype=np.int16),
        "full_scale_dbm": -20.0,
    }
    return RadarBeam(**(fields | changes))  # type: ignore[arg-type]


def peaks(count: int) -> Peaks:
    return peaks_at(RANDOM.random((count, 2)), stamp_ns=1, scan_id=1, missing_beams=(3, 4))


def bev() -> BevFrame:
    covariance = ((1.0, 0.0), (0.0, 2.0))
    return BevFrame(
        stamp_ns=1,
        scan_id=1,
        walls=(Wall(normal=(-1.0, 0.0), offset_m=9.0, ends_m=((9.0, -1.0), (9.0, 1.0)), inliers=4),),
        points=(HiddenPoint(x_m=1.0, y_m=2.0, score=0.5, image_x_m=3.0, image_y_m=4.0, wall=0),),
        objects=(example_object(id=1, x_m=1.0, y_m=2.0, yaw_rad=0.1, cov_m2=covariance),),
        tracks=(example_track(velocity_y_mps=1.0, cov_m2=covariance),),
        los_points_m=np.ones((2, 2), np.float32),
        visibility=np.zeros((160, 120), np.uint8),
    )


def detections(count: int, **columns: np.ndarray) -> RadarDetections:
    return RadarDetections(
        stamp_ns=1,
        scan_id=1,
        sensor="front",
        range_m=np.arange(count) + 1.0,
        azimuth_rad=np.zeros(count),
        covariance=np.zeros((count, 2, 2)),
        **columns,
    )


EXAMPLES: dict[str, list[msgspec.Struct]] = {
    "radar/detections": [detections(0), detections(2, snr_db=np.array([20.0, math.nan]))],
    "radar/beam": [beam(), beam(samples=np.zeros((0, 8, 2), np.int16))],
    "radar/setup": [
        RadarSetup(),
        RadarSetup(
            steering_weights=RANDOM.random((25, 8)).astype(np.complex64),
            background=RANDOM.random((25, 8192)).astype(np.complex64),
        ),
    ],
    "radar/ra_map": [
        example_map(
            (RANDOM.random(GRID.shape) * 1j).astype(np.complex64),
            stamp_ns=1,
            scan_id=1,
            grid=GRID,
            azimuth_stamp_ns=np.arange(4, dtype=np.int64),
            noise_power_mw=1e-9,
            incoherent=np.array([True, False] * 3),
        )
    ],
    "lidar/setup": [LidarSetup(spad=SpadParams(arming="gated", gates=3), grid=GRID, scan_period_s=1.0)],
    "lidar/histograms": [
        PhotonHistograms(
            stamp_ns=1,
            scan_id=0,
            counts=RANDOM.integers(0, 2**32, (4, 512), np.uint32),
            azimuth_stamp_ns=np.arange(4, dtype=np.int64),
        )
    ],
    "lidar/points": [cloud()],
    "camera/image": [CameraImage.of(jpeg(), stamp_ns=1, sensor="front")],
    "perception/peaks": [peaks(0), peaks(5)],
    "perception/hidden_objects": [bev()],
    "vehicle/state": [VehicleState(stamp_ns=3, speed_mps=4.5, valid=False, reason="stale")],
    "vehicle/gnss": [
        GnssPose(
            stamp_ns=3, latitude_deg=48.0, longitude_deg=9.0, heading_deg=-90.0, position_std_m=1.0, heading_std_deg=0.5
        )
    ],
    "environment/walls": [
        WallPriors(stamp_ns=4, source="map"),
        WallPriors(
            stamp_ns=5,
            source="lidar",
            walls=(PriorWall(ends_m=((1.0, 2.0), (3.0, 4.0)), offset_std_m=0.1, angle_std_rad=0.01, end_std_m=0.5),),
        ),
    ],
    "sim/truth": [
        SceneTruth(
            stamp_ns=1,
            scan_id=1,
            los_points_m=np.zeros((3, 3), np.float32),
            mirrored_points_m=np.ones((1, 3), np.float32),
            hidden_points_m=np.ones((1, 3), np.float32),
            hidden_object=np.array([-1], np.int32),
            objects=(TruthObject(id=1, object_class="car", x_m=1.0, y_m=2.0, length_m=4.0, width_m=2.0, yaw_rad=0.0),),
        )
    ],
    "diagnostics/node": [
        example_status(
            stamp_ns=1,
            node="a",
            pid=3,
            stages=(StageTime(name="fold", count=3, last_ms=1.0, mean_ms=1.0, max_ms=2.0),),
            received=(TopicCount(topic="log", messages=1, bytes=2),),
        )
    ],
    "log": [LogRecord(stamp_ns=1, node="a", level="info", text="wall found: 12 m")],
    "param/request": [ParamRequest(stamp_ns=1, request="1", node="a", changes='{"threads": 2}')],
    "param/values": [
        NodeParams(stamp_ns=2, node="a", params='{"threads": 1}'),
        NodeParams(stamp_ns=2, node="a", params="{}", request="1", error="threads must be 1..256, got 0"),
    ],
}
CASES = [(topic, message) for topic, messages in EXAMPLES.items() for message in messages]


def envelope(topic: str, sequence: int = 0) -> Envelope:
    return Envelope(publisher="node", topic=topic, sequence=sequence, sent_ns=7)


def assert_same(left: object, right: object) -> None:
    """Equality of messages field by field, arrays by dtype and bytes."""
    assert type(left) is type(right) or isinstance(left, np.ndarray)
    if isinstance(left, np.ndarray):
        assert isinstance(right, np.ndarray)
        assert (left.dtype, left.shape, left.tobytes()) == (right.dtype, right.shape, right.tobytes())
    elif isinstance(left, msgspec.Struct):
        for name in left.__struct_fields__:
            assert_same(getattr(left, name), getattr(right, name))
    elif isinstance(left, tuple):
        assert isinstance(right, tuple)
        for ours, theirs in zip(left, right, strict=True):
            assert_same(ours, theirs)
    else:
        assert left == right


def test_every_topic_has_an_example() -> None:
    assert EXAMPLES.keys() == TOPICS.keys()


@pytest.mark.parametrize(("topic", "message"), CASES)
def test_round_trip_on_the_wire(topic: str, message: msgspec.Struct) -> None:
    received = decode(encode(envelope(topic, sequence=4), message))
    assert received.envelope == envelope(topic, sequence=4)
    assert_same(message, received.message)


def test_a_text_that_is_no_utf8_travels_as_one_that_is() -> None:
    """The name of a file in a list of a status, and in a message with arrays, whose frames come once."""
    name, plain = "/k\udcfc/a.mcap", "/k\\xfc/a.mcap"
    shed = (ShedCount(what=name, reason="b", count=3),)
    status = NodeStatus(stamp_ns=1, node="a", pid=2, state=NodeState.DEGRADED, reason=name, shed=shed)
    found = decode(encode(envelope("diagnostics/node"), status)).message
    assert (found.reason, found.shed[0].what) == (plain, plain)
    assert codec._with_utf8({name: [name, 1]}) == {plain: [plain, 1]}
    seen = msgspec.structs.replace(EXAMPLES["radar/detections"][0], sensor=name)
    expected = msgspec.structs.replace(seen, sensor=plain)
    assert_same(decode(encode(envelope("radar/detections"), seen)).message, expected)
    assert_same(decode_inline(type(seen), encode_inline(seen)), expected)


@pytest.mark.parametrize(("topic", "message"), CASES)
def test_round_trip_inline(topic: str, message: msgspec.Struct) -> None:
    assert_same(message, decode_inline(type(message), encode_inline(message)))


@pytest.mark.parametrize(("topic", "message"), CASES)
def test_json_schema_describes_the_inline_form(topic: str, message: msgspec.Struct) -> None:
    schema = json_schema(type(message))
    jsonschema.Draft202012Validator.check_schema(schema)
    full = json.loads(json.dumps(to_builtins(message, arrays="full"), allow_nan=False))
    jsonschema.validate(full, schema)
    # the same map as msgpack: only binary data has no JSON type of its own
    inline = msgpack.unpackb(encode_inline(message))
    assert json.loads(json.dumps(inline, default=lambda data: base64.b64encode(data).decode())) == full


def test_schema_refuses_what_is_not_the_inline_form() -> None:
    full = json.loads(json.dumps(to_builtins(beam(), arrays="full")))
    full["samples"]["dtype"] = "|O8"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(full, json_schema(RadarBeam))


def test_another_msgpack_library_reads_the_header() -> None:
    message = beam()
    frames = encode(envelope("radar/beam"), message)
    header = msgpack.unpackb(frames[1])
    assert frames[0] == b"radar/beam\0"
    assert header["envelope"]["topic"] == "radar/beam"
    assert header["body"]["samples"] == {"dtype": "<i2", "shape": [2, 8, 2], "frame": 0}
    assert bytes(frames[2]) == message.samples.tobytes()


def test_arrays_are_not_copied_and_read_only() -> None:
    message = beam()
    received = decode(encode(envelope("radar/beam"), message)).message
    assert isinstance(received, RadarBeam)
    assert np.shares_memory(received.samples, message.samples)
    with pytest.raises(ValueError, match="read-only"):
        received.samples[0, 0, 0] = 1


def test_non_contiguous_arrays_travel_by_value() -> None:
    samples = RANDOM.integers(-9, 9, (2, 8, 4), dtype=np.int16)[:, :, ::2]
    received = decode(encode(envelope("radar/beam"), beam(samples=samples))).message
    assert isinstance(received, RadarBeam)
    np.testing.assert_array_equal(received.samples, samples)


def test_numpy_numbers_travel_as_plain_ones() -> None:
    message = VehicleState(stamp_ns=np.int64(3), speed_mps=np.float32(1.5), valid=np.bool_(False))  # type: ignore[arg-type]
    received = decode(encode(envelope("vehicle/state"), message)).message
    assert received == VehicleState(stamp_ns=3, speed_mps=1.5, valid=False)


def test_unknown_topic_is_not_sent() -> None:
    with pytest.raises(CodecError, match="unknown topic 'radar/nothing'"):
        encode(envelope("radar/nothing"), VehicleState(stamp_ns=1))


def test_oversize_is_not_sent_and_not_read() -> None:
    text = LogRecord(stamp_ns=1, node="a", level="info", text="x" * TOPICS["log"].max_bytes)
    with pytest.raises(CodecError, match="exceeds 65536"):
        encode(envelope("log"), text)
    with pytest.raises(CodecError, match="exceeds 65536"):
        decode([b"log\0", b"x" * TOPICS["log"].max_bytes])


def test_header_has_a_limit_of_its_own() -> None:
    with pytest.raises(CodecError, match=r"header of .* exceeds 1048576"):
        decode([b"radar/beam\0", b"\xc0" * ((1 << 20) + 1)])


def test_integer_too_large_for_msgpack() -> None:
    with pytest.raises(CodecError):
        encode_inline(_Plain(1 << 70))


def tampered(change: object, frames: list[bytes] | None = None) -> list[bytes]:
    """Frames of a beam whose header went through `change`."""
    whole = [bytes(frame) for frame in frames or encode(envelope("radar/beam"), beam())]
    header = msgpack.unpackb(whole[1])
    change(header)  # type: ignore[operator]
    return [whole[0], msgpack.packb(header), *whole[2:]]


TAMPERINGS = {
    "unknown field": (lambda h: h["body"].update(extra=1), r"unknown field - at `\$.extra`"),
    "unknown top field": (lambda h: h.update(extra=1), "extra"),
    "missing field": (lambda h: h["body"].pop("scan_id"), "scan_id"),
    "text for integer": (lambda h: h["body"].update(scan_id="2"), r"Expected `int`, got `str` - at `\$.scan_id`"),
    "float for integer": (lambda h: h["body"].update(scan_id=2.5), "Expected `int`"),
    "bool for integer": (lambda h: h["body"].update(scan_id=True), "Expected `int`"),
    "value its type refuses": (lambda h: h["body"].update(beam_index=9), "beam.beam_index must be"),
    "not finite": (lambda h: h["body"].update(azimuth_rad=math.nan), "Expected `float` >= -3.14"),
    "protocol": (lambda h: h["envelope"].update(protocol=2), "protocol must be 1"),
    "other topic": (lambda h: h["envelope"].update(topic="log"), "topic must be that of the first frame"),
    "negative sequence": (lambda h: h["envelope"].update(sequence=-1), "sequence must not be negative"),
    "object dtype": (lambda h: h["body"]["samples"].update(dtype="|O8"), "dtype must be one of the permitted"),
    "big-endian dtype": (lambda h: h["body"]["samples"].update(dtype=">i2"), "dtype must be one of the permitted"),
    "field's other dtype": (lambda h: h["body"]["samples"].update(dtype="<u2"), "beam.samples must have dtype <i2"),
    "negative length": (lambda h: h["body"]["samples"].update(shape=[-2, -8, 2]), "none negative"),
    "seven dimensions": (lambda h: h["body"]["samples"].update(shape=[2, 8, 2, 1, 1, 1, 1]), "at most 6 lengths"),
    "wrong product": (lambda h: h["body"]["samples"].update(shape=[2, 8, 3]), "needs 96 bytes, got 64"),
    # 2^62 * 4 * 2 bytes is 2^65: zero in 64 bits
    "overflowing product": (lambda h: h["body"]["samples"].update(shape=[1 << 62, 4, 2]), "needs .* bytes, got 64"),
    "frame out of range": (lambda h: h["body"]["samples"].update(frame=1), "frame must be one of 1"),
    "negative frame": (lambda h: h["body"]["samples"].update(frame=-1), "frame must be one of 1"),
    "array not described": (lambda h: h["body"].update(samples=[1, 2]), "samples"),
    "unknown array field": (lambda h: h["body"]["samples"].update(extra=1), "extra"),
    "frame of no field": (lambda h: h["body"].update(samples=None), "samples"),
}


@pytest.mark.parametrize("name", TAMPERINGS)
def test_tampered_header_is_refused_in_one_line(name: str) -> None:
    change, reason = TAMPERINGS[name]
    with pytest.raises(CodecError, match=reason) as refused:
        decode(tampered(change))
    assert "\n" not in str(refused.value)
    assert str(refused.value).startswith("radar/beam: ")


def test_one_frame_cannot_serve_two_fields() -> None:
    frames = encode(envelope("perception/peaks"), peaks(3))
    with pytest.raises(CodecError, match="each used once"):
        decode(tampered(lambda h: h["body"]["score"].update(frame=0), frames))  # type: ignore[arg-type]


def test_frames_left_over_are_refused() -> None:
    with pytest.raises(CodecError, match="1 of 2 array frames belong to no field"):
        decode([*encode(envelope("radar/beam"), beam()), b"more"])


def test_empty_array_of_absurd_shape() -> None:
    frames = encode(envelope("radar/beam"), beam(samples=np.zeros((0, 8, 2), np.int16)))
    with pytest.raises(CodecError):
        decode(tampered(lambda h: h["body"]["samples"].update(shape=[0, 1 << 62, 2]), frames))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "frames", [[], [b"log\0"], [b"log", b"\x80"], [b"lo\0", b"\x80"], [b"", b""], [b"\xff\0", b""]]
)
def test_first_frame_must_be_a_topic(frames: list[bytes]) -> None:
    with pytest.raises(CodecError):
        decode(frames)


def test_summary_of_arrays_stays_small_and_valid_json() -> None:
    values = np.full(GRID.shape, 3.0 - 4.0j, np.complex64)
    values[0, 0], values[0, 1], values[1, 1] = np.nan, 0.0, 10.0
    assert json.loads(json.dumps(to_builtins(_Any(values)), allow_nan=False))["array"] == {
        "dtype": "<c8",
        "shape": [6, 4],
        "min": 0.0,
        "max": 10.0,
        "mean": 5.0,
    }


def test_non_finite_numbers_become_null() -> None:
    assert [to_builtins(_Plain(number)) for number in (math.inf, math.nan, 1.0)] == [
        {"number": None}, {"number": None}, {"number": 1.0},
    ]  # fmt: skip


class _Plain(msgspec.Struct, frozen=True):
    number: float


class _Any(msgspec.Struct, frozen=True, eq=False):
    array: np.ndarray


@settings(max_examples=60, deadline=None)
@given(
    dtype=st.sampled_from(sorted(DTYPES)),
    shape=st.lists(st.integers(0, 4), max_size=6).map(tuple),
    order=st.sampled_from("CF"),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_permitted_array_survives(dtype: str, shape: tuple[int, ...], order: str, seed: int) -> None:
    size = math.prod(shape) * np.dtype(dtype).itemsize
    raw = np.random.default_rng(seed).bytes(size)
    if dtype == "|b1":
        raw = bytes(byte & 1 for byte in raw)
    array = np.asarray(np.frombuffer(raw, dtype).reshape(shape), order=order)  # type: ignore[call-overload]
    assert_same(array, decode_inline(_Any, encode_inline(_Any(array))).array)


@settings(max_examples=150, deadline=None)
@given(topic=st.sampled_from(sorted(TOPICS)), garbage=st.lists(st.binary(max_size=80), max_size=4))
def test_garbage_is_refused_and_nothing_else(topic: str, garbage: list[bytes]) -> None:
    with pytest.raises(CodecError):
        decode([topic.encode() + b"\0", *garbage])


@settings(max_examples=200, deadline=None)
@given(case=st.sampled_from(CASES), flips=st.lists(st.tuples(st.floats(0, 0.999), st.integers(1, 255)), min_size=1))
def test_flipped_bytes_give_a_message_or_a_refusal(
    case: tuple[str, msgspec.Struct], flips: list[tuple[float, int]]
) -> None:
    topic, message = case
    frames = encode(envelope(topic), message)
    refusals = [
        refusal(lambda: decode([frames[0], flipped(frames[1], flips), *frames[2:]])),
        refusal(lambda: decode_inline(type(message), flipped(encode_inline(message), flips))),
    ]
    assert not any("\n" in reason for reason in refusals)


def flipped(data: object, flips: list[tuple[float, int]]) -> bytes:
    damaged = bytearray(data)  # type: ignore[call-overload]
    for share, mask in flips:
        damaged[int(share * min(len(damaged), 400))] ^= mask
    return bytes(damaged)


def refusal(read: Callable[[], object]) -> str:
    """The reason of a `CodecError`, empty where none came; anything else passes through and fails the test."""
    try:
        read()
    except CodecError as refused:
        return str(refused)
    return ""


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    message=st.builds(
        VehicleState,
        stamp_ns=st.integers(0, MAX_STAMP_NS),
        speed_mps=st.floats(-MAX_SPEED_MPS, MAX_SPEED_MPS),
        valid=st.booleans(),
        reason=st.text(max_size=30),
    )
)
def test_any_scalar_values_survive(message: VehicleState) -> None:
    assert decode(encode(envelope("vehicle/state"), message)).message == message
    assert decode_inline(VehicleState, encode_inline(message)) == message
    # floats keep every bit, the sign of zero included
    again = decode_inline(VehicleState, encode_inline(message))
    assert struct.pack("<d", again.speed_mps) == struct.pack("<d", message.speed_mps)


def test_vehicle_states_of_an_older_version_know_no_wheels() -> None:
    """A recording of before lacks the difference of the wheels: None, and all else as it was."""
    state = VehicleState(stamp_ns=7, speed_mps=3.0, yaw_rate_rps=0.1, steering_rad=0.2, age_s=0.01)
    new = msgspec.msgpack.decode(encode_inline(state))
    assert new.pop("wheel_speed_difference_mps") is None
    assert set(new) == {"stamp_ns", "speed_mps", "yaw_rate_rps", "steering_rad", "valid", "reason", "age_s"}
    assert decode_inline(VehicleState, msgspec.msgpack.encode(new)) == state


def test_heartbeats_of_an_older_version_read_as_zero() -> None:
    """New fields have defaults: what a recording of before lacks was not counted then."""
    old = {
        "stamp_ns": 1, "node": "ra_former", "pid": 2, "state": "ready",
        "stages": [{"name": "fold", "count": 3, "last_ms": 1.0, "mean_ms": 1.0, "max_ms": 2.0}],
        "received": [{"topic": "log", "messages": 1, "bytes": 2}],
    }  # fmt: skip
    status = msgspec.msgpack.decode(msgspec.msgpack.encode(old), type=NodeStatus)
    assert status.shed == ()
    assert status.stages[0].samples_ms == ()
    assert status.received[0].outdated == 0
