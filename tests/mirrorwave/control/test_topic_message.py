"""A message from what a person writes: whole, of defaults, of lists and files; refused with one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from mirrorwave.control.topic_message import message_of
from msgs.bus.codec import to_builtins
from msgs.values.vehicle import VehicleState
from tests.msgs.bus.test_codec import EXAMPLES

PEAKS = {
    "stamp_ns": 5,
    "scan_id": 1,
    "range_m": [10.0, 12.5],
    "azimuth_rad": [0.0, 0.1],
    "score": [0.5, 0.5],
    "path_class": {"values": [0, 1], "dtype": "u1"},
    "covariance": [[[1.0, 0.0], [0.0, 1.0]]] * 2,
    "peak_stamp_ns": [1, 2],
    "snr_db": [20.0, 30.0],
}


@pytest.mark.parametrize("topic", EXAMPLES)
def test_what_echo_prints_whole_can_be_published_again(topic: str) -> None:
    """Every example of every topic, through JSON: the same message, its NaNs as the null that JSON makes of them."""
    for message in EXAMPLES[topic]:
        shown = msgspec.json.decode(msgspec.json.encode(to_builtins(message, "full")))
        again = message_of(topic, shown, now_ns=7)
        assert msgspec.json.decode(msgspec.json.encode(to_builtins(again, "full"))) == shown


def test_what_is_not_given_has_its_default_and_the_stamp_is_the_time() -> None:
    assert message_of("vehicle/state", {"speed_mps": 3}, 7) == VehicleState(stamp_ns=7, speed_mps=3.0)
    assert message_of("vehicle/state", {"stamp_ns": 1}, 7) == VehicleState(stamp_ns=1)


def test_arrays_are_lists_or_files(tmp_path: Path) -> None:
    np.save(tmp_path / "range.npy", np.array([10.0, 12.5]))
    message: Any = message_of("perception/peaks", {**PEAKS, "range_m": {"npy": str(tmp_path / "range.npy")}}, 0)
    assert message.range_m.tolist() == [10.0, 12.5]
    assert (message.path_class.dtype, message.covariance.shape) == (np.uint8, (2, 2, 2))


@pytest.mark.parametrize(
    ("topic", "changes", "rule"),
    [
        ("vehicle/state", {"speed": 3}, r"vehicle/state: unknown field 'speed'; known are .*speed_mps"),
        ("vehicle/state", {"speed_mps": "fast"}, r"vehicle/state: Expected `?float`?, got `?str`?"),
        ("vehicle/state", {"speed_mps": float("nan")}, r"vehicle/state: Expected float >= -1000.0 - at \$.speed_mps"),
        ("vehicle/state", {"stamp_ns": 10**30}, "vehicle/state: stamp_ns must have whole numbers of 64 bits, got 1000"),
        ("radar/nope", {}, "unknown topic 'radar/nope'"),
        ("perception/peaks", {**PEAKS, "path_class": [0, 1]}, r"peaks.path_class must have dtype \|u1, got <i8"),
        ("perception/peaks", {**PEAKS, "path_class": {"values": [-1, 999], "dtype": "u1"}}, "a list of numbers of u1"),
        ("perception/peaks", {**PEAKS, "range_m": [[1.0], [1.0, 2.0]]}, "range_m must be a list of numbers"),
        ("perception/peaks", {**PEAKS, "range_m": ["a", "b"]}, "range_m must be a list of numbers"),
        ("perception/peaks", {**PEAKS, "range_m": 3}, r"range_m must be a list, \{values: LIST, dtype: NAME\}"),
        ("perception/peaks", {**PEAKS, "range_m": {"dtype": "<f8", "shape": [1], "data": "!"}}, "must be base64"),
        ("perception/peaks", {**PEAKS, "range_m": [1.0]}, "peaks.azimuth_rad must have shape"),
        ("environment/walls", {}, "missing required field"),
    ],
)
def test_what_does_not_fit_is_refused_by_one_line(topic: str, changes: dict[str, Any], rule: str) -> None:
    with pytest.raises(ValueError, match=rule) as refused:
        message_of(topic, changes, 0)
    assert "\n" not in str(refused.value)


#: Of an array of 8 TB, of which nothing follows.
_PROMISE = (
    b"\x93NUMPY\x01\x00v\x00"
    + b"{'descr': '<f8', 'fortran_order': False, 'shape': (10**12,)}".replace(b"10**12", b"1000000000000").ljust(117)
    + b"\n"
)


@pytest.mark.parametrize("content", [b"", b"no array", b"PK\x03\x04", _PROMISE])
def test_a_file_that_holds_no_array_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "range.npy"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"perception/peaks: range_m: .*range\.npy"):
        message_of("perception/peaks", {**PEAKS, "range_m": {"npy": str(path)}}, 0)
