"""Groups of frames and numbers of the evaluation's report."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from lab.evaluate.method_report import _spelled, group_masks, interval_text


def facts(place: str = "", relays: tuple[str, ...] = (), hidden: tuple[str, ...] = (), sequence: str = "") -> Any:
    return SimpleNamespace(place=place, relays=relays, hidden=hidden, sequence=sequence)


def test_frames_are_grouped_by_all_that_is_known_of_them() -> None:
    """A frame is in each of its kinds; what is not known makes none, nor does a sequence of one frame."""
    frames = [
        facts("corner", ("metal", "glass"), ("car",), "a"),
        facts("corner", ("metal",), ("car", "van", "bus", "car"), "a"),
        facts("yard", ("wood",), (), "b"),
        facts("", (), ("car",), ""),
    ]
    groups = {(kind, value): mask.tolist() for kind, value, mask in group_masks(frames)}
    assert groups == {
        ("place", "corner"): [True, True, False, False],
        ("place", "yard"): [False, False, True, False],
        ("relay", "glass"): [True, False, False, False],
        ("relay", "metal"): [True, True, False, False],
        ("relay", "wood"): [False, False, True, False],
        ("hidden objects", "0"): [False, False, True, False],
        ("hidden objects", "1"): [True, False, False, False],
        ("hidden objects", "3+"): [False, True, False, False],
        ("hidden class", "bus"): [False, True, False, False],
        ("hidden class", "car"): [True, True, False, True],
        ("hidden class", "van"): [False, True, False, False],
        ("sequence", "a"): [True, True, False, False],
    }


def test_numbers_that_json_lacks_are_spelled() -> None:
    assert interval_text((0.12345, 0.1, 0.2)) == "0.123 [0.1, 0.2]"
    assert interval_text((math.nan, 0.1, 0.2)) == "-"
    assert _spelled(np.array([[[1.0, math.inf]]])) == [[[1.0, "inf"]]]
