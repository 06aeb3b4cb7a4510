"""Priors at a scan: which messages count for it, and where the vehicle's motion puts their walls."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from models.perception.mirrors.peaks_to_view import GeometryParams, WithPriors
from models.perception.see.scan_evidence import CANDIDATE_WALLS
from models.perception.track.odometry import OdometryPose
from models.perception.track.scan_state import MemoryParams
from models.perception.track.views_over_scans import ViewStage
from models.perception.track.wall_priors import MAX_SOURCES, MAX_WAITING_MESSAGES, WallPriorStore
from msgs.bus.codec import encode_inline
from msgs.values.environment import PriorWall, WallPriors
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, Peaks, Wall
from msgs.values.vehicle import VehicleState, ego_motion
from tests.builders import peaks_at

START_NS, PERIOD_NS = 5_000_000_000, 300_000_000
FRONT = Pose2()
COLUMNS = ("range_m", "azimuth_rad", "score", "path_class", "snr_db", "covariance", "peak_stamp_ns")
#: A wall on the left that the scans below do not see, in the vehicle's frame at the start.
LEFT = ((8.0, 12.0), (24.0, 12.0))


def message(
    stamp_ns: int = START_NS, ends_m: tuple[tuple[float, float], tuple[float, float]] = LEFT, source: str = "map"
) -> WallPriors:
    wall = PriorWall(ends_m=ends_m, offset_std_m=0.1, angle_std_rad=0.01, end_std_m=0.2)
    return WallPriors(stamp_ns=stamp_ns, source=source, walls=(wall,))


def scan(number: int, vehicle_from_radar: Pose2 = FRONT) -> Peaks:
    """A facade ahead and images behind the wall on the left, of a vehicle that the facade's end hides."""
    facade_m = np.stack([np.full(9, 20.0), np.linspace(-8.0, 4.0, 9)], axis=1)
    images_m = [[17.0, 18.0], [17.5, 18.5], [17.2, 19.0]]
    stamp_ns = START_NS + number * PERIOD_NS
    return peaks_at(
        facade_m, images_m, (0.06, 0.01), stamp_ns=stamp_ns, scan_id=number, snr_db=np.full(12, 20.0),
        vehicle_from_radar=vehicle_from_radar,
    )  # fmt: skip


def stage(**memory: object) -> ViewStage:
    return ViewStage(GeometryParams(), memory=MemoryParams(tracking=False, **memory))  # type: ignore[arg-type]


def view(messages: list[WallPriors], number: int = 0, states: list[VehicleState] | None = None) -> BevFrame:
    """The view of a scan after messages and states."""
    views = stage()
    for state in states or []:
        views.add_state(state)
    for item in messages:
        views.add_walls(item)
    return views.view(scan(number))


def driven(speed_mps: float, yaw_rate_rps: float = 0.0, until_s: float = 1.0) -> list[VehicleState]:
    stamps_ns = range(START_NS - PERIOD_NS, START_NS + round(1e9 * until_s), 20_000_000)
    return [VehicleState(stamp_ns=ns, speed_mps=speed_mps, yaw_rate_rps=yaw_rate_rps) for ns in stamps_ns]


def test_a_prior_mirrors_what_the_scan_alone_cannot_place() -> None:
    """Images 6 to 7 m behind y = 12 m are objects 6 to 7 m before it."""
    alone, helped = view([]), view([message()])
    assert (len(alone.walls), len(alone.objects)) == (1, 0)
    assert (len(helped.walls), len(helped.objects)) == (2, 1)
    assert helped.objects[0].y_m == pytest.approx(24.0 - 18.5, abs=1.0)


def test_without_messages_views_have_the_same_bytes() -> None:
    """And so they have with a source that knows of no walls."""
    assert encode_inline(view([WallPriors(stamp_ns=START_NS, source="map")])) == encode_inline(view([]))


@pytest.mark.parametrize(
    ("age_ns", "walls"), [(0, 2), (2_000_000_000, 2), (2_000_000_001, 1), (-1, 1), (-10 * PERIOD_NS, 1)]
)
def test_walls_count_from_their_stamp_on_until_they_are_too_old(age_ns: int, walls: int) -> None:
    """For two seconds; those of the future wait."""
    assert len(view([message(START_NS - age_ns)]).walls) == walls


def test_the_newest_message_in_time_is_the_sources_word() -> None:
    """Whatever order they come in; one without walls takes all of them back."""
    older, newer = message(START_NS - 5, ((8.0, 14.0), (24.0, 14.0))), message(START_NS - 3)
    later = message(START_NS + 1, ((8.0, 13.0), (24.0, 13.0)))
    for order in ([older, newer, later], [later, newer, older]):
        assert view(order).walls[1].offset_m == pytest.approx(12.0)
    empty = WallPriors(stamp_ns=START_NS - 1, source="map")
    assert len(view([newer, empty]).walls) == 1


@pytest.mark.parametrize(("speed_mps", "yaw_rate_rps"), [(5.0, 0.0), (-2.0, 0.0), (4.0, 0.2), (0.0, -0.3)])
def test_walls_move_with_the_vehicle(speed_mps: float, yaw_rate_rps: float) -> None:
    """Two scans after the message: the exact arc of constant motion, to 1 mm (states hold 20 ms, exactly here)."""
    placed = placed_at(2, driven(speed_mps, yaw_rate_rps), Pose2())
    now_from_then = ego_motion(speed_mps, yaw_rate_rps, 0.6).inverse()
    np.testing.assert_allclose(sorted_ends(placed), sorted_ends(now_from_then.apply(np.array(LEFT))), atol=1e-3)


def test_walls_are_moved_into_the_frame_of_a_mounted_radar() -> None:
    mounted = Pose2(1.5, -0.3, math.radians(10.0))
    placed = placed_at(0, [], mounted)
    np.testing.assert_allclose(sorted_ends(placed), sorted_ends(mounted.inverse().apply(np.array(LEFT))), atol=1e-9)


def placed_at(number: int, states: list[VehicleState], mounted: Pose2) -> np.ndarray:
    """Ends of the one prior at a scan, in its radar frame."""
    memory = stage()._memory
    for state in states:
        memory.add(state)
    memory.add_walls(message())
    peaks = scan(number, mounted)
    memory._odometry.at(peaks.stamp_ns)
    (placed,) = memory._priors.at(peaks.stamp_ns, memory._odometry.before, mounted)
    assert placed.source == "map"
    return placed.line.ends_m


def sorted_ends(ends_m: np.ndarray) -> list[list[float]]:
    return sorted(np.asarray(ends_m).tolist())


def test_driving_makes_walls_uncertain() -> None:
    """3 m since the message, at 0.02 m and 0.05 deg a metre: sqrt(0.1^2 + 0.06^2) m."""
    views = stage()
    for state in driven(5.0):
        views.add_state(state)
    views.add_walls(message(ends_m=((10.0, 12.0), (30.0, 12.0))))
    added = views.view(scan(2)).walls[1]
    assert added.offset_std_m == pytest.approx(math.hypot(0.1, 0.02 * 3.0), rel=1e-6)
    assert added.angle_std_rad == pytest.approx(math.hypot(0.01, math.radians(0.05) * 3.0), rel=1e-6)


def test_walls_of_another_odometry_frame_are_left_out() -> None:
    """States silent for longer than a second: nobody knows where the vehicle went meanwhile."""
    before = VehicleState(stamp_ns=START_NS - 5, speed_mps=5.0)
    after = VehicleState(stamp_ns=START_NS + 5 * PERIOD_NS - 5, speed_mps=5.0)
    assert len(view([message(START_NS)], 5, [before, after]).walls) == 1
    assert len(view([message(START_NS + 5 * PERIOD_NS)], 5, [before, after]).walls) == 2


def test_a_pose_that_jumped_moves_no_walls() -> None:
    """Poses of two odometry frames have no motion between them."""
    store = WallPriorStore()
    store.add(message(START_NS))
    for frame, count in ((0, 1), (1, 0)):
        poses = {START_NS: OdometryPose(0, Pose2(), 0.0, 0.0), START_NS + 5: OdometryPose(frame, Pose2(9.0), 0.0, 0.0)}
        assert len(store.at(START_NS + 5, poses.get, Pose2())) == count


def test_sources_and_messages_are_bounded() -> None:
    """The source that has been silent for longest goes first; of each, the newest messages wait."""
    store = WallPriorStore()
    assert not store
    for number in range(MAX_SOURCES + 1):
        store.add(message(START_NS, source=f"map {number}"))
    placed = store.at(START_NS, lambda stamp_ns: None, Pose2())
    assert {item.source for item in placed} == {f"map {number}" for number in range(1, MAX_SOURCES + 1)}
    for number in range(MAX_WAITING_MESSAGES):
        store.add(message(START_NS + number, source="map 1"))
    assert "map 1" in {item.source for item in store.at(START_NS, lambda stamp_ns: None, Pose2())}
    store.add(message(START_NS + PERIOD_NS, source="map 1"))
    assert "map 1" not in {item.source for item in store.at(START_NS, lambda stamp_ns: None, Pose2())}


def test_the_evidence_network_adds_priors_to_the_walls_it_found() -> None:
    """A map joins whatever walls the network has: those of the view, none, or the map's own wall a little off."""
    judged: list[tuple[list[Wall], WithPriors | None]] = []

    class Judge:
        card, walls = SimpleNamespace(), CANDIDATE_WALLS

        def suits(self, ra_map: object) -> bool:
            return True

        def judge(
            self, ra_map: object, walls: list[Wall], with_priors: WithPriors | None, **rest: object
        ) -> Callable[..., tuple]:
            judged.append((walls, with_priors))
            return lambda *mask: ()

    views = ViewStage(memory=MemoryParams(tracking=False), predictor=Judge())  # type: ignore[arg-type]
    peaks = msgspec.structs.replace(scan(0), detector="sha256/pursuit")
    views.view(peaks, object())  # type: ignore[arg-type]
    views.add_walls(message())
    both = views.view(peaks, object()).walls  # type: ignore[arg-type]
    (_, nothing), (fitted, with_priors) = judged
    assert nothing is None
    assert with_priors is not None
    assert (len(fitted), len(both)) == (1, 2)
    assert with_priors(fitted) == list(both)
    (alone,) = with_priors([])
    assert alone == both[1]
    off = msgspec.structs.replace(alone, offset_m=alone.offset_m + 0.1, inliers=9)
    (corrected,) = with_priors([off])
    assert 0.0 < off.offset_m - corrected.offset_m < 0.1


def test_a_message_replaces_nothing_of_another_source() -> None:
    second = msgspec.structs.replace(message(ends_m=((10.0, -13.0), (22.0, -13.0))), source="lidar")
    assert len(view([message(), second]).walls) == 3
