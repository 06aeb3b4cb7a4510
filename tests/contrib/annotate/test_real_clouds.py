"""Registration of two pairs of real clouds, where they are at hand; the trap in which ground rings slide."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest

from benchmarks.perception.annotation import pose_error
from benchmarks.perception.real_clouds import PARAMS, apart_m, car_pair, first_pose, registered, street_pair
from contrib.annotate.registration import VOXELS_M, PosedCloud, _Clouds, _judged
from tests.captures import DATA, needs

PAIRS = DATA / "lidar_pairs"


@needs(PAIRS)
@pytest.mark.slow
@pytest.mark.parametrize("first", ["no motion", "off", "unknown"])
def test_street_comes_to_its_reference(first: str) -> None:
    """0.5 m of motion between two scans of a street, from three first poses. Tolerance 3 cm and 0.4 deg: the reference
    is another registration, and the ground and the walls of these scans differ by 0.3 deg about it."""
    pair = street_pair(DATA)
    start = {"no motion": np.eye(4), "off": first_pose(pair, 0), "unknown": None}[first]
    result = registered(pair, start)
    away_m, turned_rad = pose_error(pair.target_from_source, result.target_from_source)
    assert away_m <= 0.03
    assert math.degrees(turned_rad) <= 0.4
    assert result.fault(PARAMS) is None


@needs(PAIRS)
@pytest.mark.slow
def test_the_streets_ground_prefers_no_motion_and_the_score_does_not() -> None:
    """The trap: about the sensor, rings of ground lie nearer to one another where the car did not move. The score of a
    pose must say the opposite, by more than a tenth of the points."""
    pair = street_pair(DATA)
    still, right = np.eye(4), pair.target_from_source
    assert apart_m(pair, still)[1] < 0.7 * apart_m(pair, right)[1]
    clouds = _Clouds(pair.source_m, [PosedCloud(pair.target_m, np.eye(4))])
    scores = [_judged(clouds, pose, VOXELS_M[-1], "given").score for pose in (still, right)]
    assert scores[1] > scores[0] + 0.1


@needs(PAIRS)
@pytest.mark.slow
def test_car_comes_to_its_reference_and_what_moved_is_named() -> None:
    """Two scans 14 deg apart. Tolerance 5 cm and 0.4 deg: the two references of this pair differ by 10 cm and 0.5 deg.
    Something the size of a car stood 4 m ahead in the first scan only: refused, with its place."""
    pair = car_pair(DATA)
    result = registered(pair, first_pose(pair, 0))
    away_m, turned_rad = pose_error(pair.target_from_source, result.target_from_source)
    assert away_m <= 0.05
    assert math.degrees(turned_rad) <= 0.4
    assert "half of them within 1.5 m of (3.8, 0.8, -0.1) m" in (result.fault(PARAMS) or "")
    assert result.fault(msgspec.structs.replace(PARAMS, max_conflict=0.05)) is None


@needs(PAIRS)
def test_a_pulse_without_echo_is_no_point_at_the_sensor() -> None:
    """7 % of the street's points are zeros, which another viewpoint would have looked through."""
    assert np.linalg.norm(street_pair(DATA).source_m, axis=1).min() > 1.0
