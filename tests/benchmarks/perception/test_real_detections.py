"""What is reached on real 77 GHz detections; the data stay outside, and the tests skip by name without them."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.perception.astyx_frames import IMAGE_FRAME
from benchmarks.perception.real_detections import run
from tests.captures import DATA, needs

ASTYX = DATA / "astyx_77ghz"


@pytest.fixture(scope="module")
def figures() -> dict[str, Any]:
    return run(ASTYX)


@needs(ASTYX)
def test_the_facade_lies_on_the_lidar_s(figures: dict[str, Any]) -> None:
    for span in ("whole", "shared"):
        assert abs(figures["facade"][span]["distance_m"]) <= 0.1
        assert abs(figures["facade"][span]["angle_deg"]) <= 0.3


@needs(ASTYX)
def test_images_of_the_trucks_fold_onto_their_direct_returns(figures: dict[str, Any]) -> None:
    """Eight or more returns each, and the trucks, in plain sight, are no hidden objects."""
    assert len(figures["trucks"]) == 3
    for truck in figures["trucks"]:
        assert truck["folded"] >= 8
        assert truck["apart_m"] <= 1.5


@needs(ASTYX)
def test_images_of_the_left_hand_walls_fold_onto_them(figures: dict[str, Any]) -> None:
    for wall in figures["left_walls"]:
        assert wall["folded"] >= 50
        assert abs(wall["median_y_m"] - wall["lidar_y_m"]) <= 1.0


@needs(ASTYX)
def test_frames_without_an_image_report_at_most_one_object_each_on_average(figures: dict[str, Any]) -> None:
    counts = [count for frame, count in figures["hidden_objects"].items() if frame != IMAGE_FRAME]
    assert len(counts) == 5
    assert sum(counts) <= 5
