"""Names and numbers of messages for the plots."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest

from msgs.values.perception import HiddenObject, Track
from msgs.values.vehicle import VehicleState
from nodes.viewer.numeric_fields import MAX_KEY_LENGTH, numeric_fields
from tests.builders import example_view


class Inner(msgspec.Struct):
    name: str
    mean_ms: float


class Outer(msgspec.Struct):
    stamp_ns: int
    count: int
    share: Any
    stages: tuple[Inner, ...] = ()
    text: str = "7"
    none: float | None = None


def test_names_lead_to_numbers() -> None:
    message = Outer(stamp_ns=5, count=3, share=0.25, stages=(Inner("detect", 4.0), Inner("map", 5.0)))
    assert dict(numeric_fields(message)) == {
        "count": 3.0, "share": 0.25, "stages.count": 2.0, "stages.detect.mean_ms": 4.0, "stages.map.mean_ms": 5.0,
    }  # fmt: skip


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300, np.float32(np.nan)])
def test_what_no_axis_can_hold_is_nan(value: float) -> None:
    assert math.isnan(dict(numeric_fields(Outer(stamp_ns=0, count=1, share=value)))["share"])


@pytest.mark.parametrize("value", ["text", None, b"7", (1.0, 2.0), np.ones(3), ((1.0, 0.0), (0.0, 1.0))])
def test_what_is_no_number_is_left_out(value: Any) -> None:
    assert set(dict(numeric_fields(Outer(stamp_ns=0, count=1, share=value)))) == {"count", "stages.count"}


def test_truth_values_and_empty_lists_are_numbers() -> None:
    fields = dict(numeric_fields({"valid": True, "flags": ["incoherent"], "faults": []}))
    assert fields == {"valid": 1.0, "flags.count": 1.0, "faults.count": 0.0}


def test_a_long_key_is_cut() -> None:
    ((name, _),) = [item for item in numeric_fields([{"name": "x" * 1000, "a": 1}]) if item[0] != "count"]
    assert name == "x" * MAX_KEY_LENGTH + ".a"


def test_a_view_has_its_objects_and_tracks_by_number() -> None:
    covariance = ((0.04, 0.0), (0.0, 0.04))
    frame = example_view(
        ego=VehicleState(stamp_ns=0, speed_mps=4.0),
        objects=(
            HiddenObject(
                id=7, x_m=1.0, y_m=2.0, length_m=4.0, width_m=2.0, yaw_rad=0.0, score=0.9, cov_m2=covariance
            ),
        ),
        tracks=(
            Track(
                id=12, x_m=1.0, y_m=2.0, velocity_x_mps=3.0, velocity_y_mps=0.0, age_s=1.0, cov_m2=covariance
            ),
        ),
    )  # fmt: skip
    fields = dict(numeric_fields(frame))
    assert fields["objects.7.score"] == 0.9
    assert fields["tracks.12.velocity_x_mps"] == 3.0
    assert fields["ego.speed_mps"] == 4.0
    assert (fields["objects.count"], fields["tracks.count"]) == (1.0, 1.0)
    assert "tracks.12.time_to_appear_s" not in fields
