"""What outlasts a scan: which vehicle states count for it, and that nothing but their stamps decides."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from models.perception.find.detectors import CfarDetector
from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import FormingParams
from models.perception.track.odometry import MAX_WAITING_STATES, Odometry, ScanOdometry, stationary_pose
from models.perception.track.scan_state import MemoryParams, ScanMemory
from models.perception.track.views_over_scans import ViewStage
from msgs.bus.interface import Envelope, Received
from msgs.values.frames import Pose2, polar_from_xy, xy_from_polar
from msgs.values.perception import Peaks
from msgs.values.radar import RadarSetup
from msgs.values.vehicle import VehicleState
from nodes import geometry
from nodes.player import Params, scene_player
from nodes.process.launch_file import read_launch_file
from tests.builders import cfar_chain, peaks_at

START_NS, PERIOD_NS, STATE_NS = 5_000_000_000, 300_000_000, 20_000_000
SCANS = 6


def scan(number: int) -> Peaks:
    """A wall ahead and four images behind it, the same in each scan."""
    wall_m = np.stack([np.full(11, 20.0), np.linspace(-8.0, 12.0, 11)], axis=1)
    images_m = [[27.0, 6.0], [27.5, 7.0], [28.0, 6.5], [28.0, 8.0]]
    stamp_ns = START_NS + number * PERIOD_NS
    return peaks_at(wall_m, images_m, (0.06, 0.01), stamp_ns=stamp_ns, scan_id=number, snr_db=np.full(15, 20.0))


def states() -> list[VehicleState]:
    """50 a second, from a second before the first scan on, none at the stamp of a scan; speed and turn vary."""
    stamps_ns = range(START_NS - 1_000_000_000 + 7_000_000, START_NS + SCANS * PERIOD_NS, STATE_NS)
    return [
        VehicleState(stamp_ns=ns, speed_mps=0.5 + 0.2 * math.sin(1e-9 * ns), yaw_rate_rps=0.1 * math.cos(2e-9 * ns))
        for ns in stamps_ns
    ]


def shuffled(rng: np.random.Generator) -> Iterator[list[VehicleState | Peaks]]:
    """What a node gets, step by step: peaks a scan and more after their stamp, states whenever, but before the peaks
    of the first scan that is not older than they are."""
    waiting = states()
    for number in range(SCANS):
        peaks = scan(number)
        due = [one for one in waiting if one.stamp_ns <= peaks.stamp_ns]
        later = [one for one in waiting if one.stamp_ns > peaks.stamp_ns]
        # of the later ones any may have come by then
        early = [one for one in later if one.stamp_ns <= peaks.stamp_ns + 2 * PERIOD_NS and rng.random() < 0.5]
        waiting = [one for one in later if one not in early]
        came = [*due, *early]
        order = rng.permutation(len(came))
        cut = int(rng.integers(0, len(came) + 1))
        yield [came[index] for index in order[:cut]]
        yield [peaks, *(came[index] for index in order[cut:])]


def lines(steps: Iterator[list[VehicleState | Peaks]]) -> str:
    """Tracks of every view the node gives."""
    node = geometry.create(geometry.Params())
    told = []
    for messages in steps:
        received = [
            Received(
                topic := "perception/peaks" if isinstance(one, Peaks) else "vehicle/state",
                one,
                Envelope(publisher="test", topic=topic, sequence=0, sent_ns=0),
            )
            for one in messages
        ]
        told += [out.message for out in node.step(received, 0)]
    return "\n".join(repr(view.tracks) for view in told)


def test_arrival_does_not_decide() -> None:
    """States and peaks as they come, in any order within the bounds: the same tracks to the last bit."""
    in_order = lines(iter([[*states()], *([scan(number)] for number in range(SCANS))]))
    assert in_order.count("velocity_x_mps") >= 3
    for seed in range(5):
        assert lines(shuffled(np.random.default_rng(seed))) == in_order


@pytest.mark.parametrize("tracking", [True, False])
def test_a_chain_follows_objects_unless_it_is_told_not_to(tracking: bool) -> None:
    """Four images behind a wall in each of six scans: an object in every view, and its track where wanted."""
    setup = RadarSetup()
    chain = cfar_chain(setup, memory=MemoryParams(tracking=tracking))
    views = [chain.views.view(scan(number)) for number in range(SCANS)]
    assert all(view.objects for view in views)
    assert bool(views[-1].tracks) is tracking


@pytest.mark.slow
def test_the_chain_says_the_same_as_the_node() -> None:
    player = scene_player(Params(scene="launch/drives/side_street.yaml", chirps_per_beam=4, effects="basic"))
    chain = cfar_chain(player.setup)
    memory = ScanMemory(MemoryParams())
    for number in range(4):
        state = player.vehicle_state(player.stamp_ns(number))
        memory.add(state)
        frames = [view.frame for index in range(25) for view in chain.add(player.beam(number, index), state)]
        tracks = memory.tracked(frames[0], Pose2()).tracks
        assert frames[0].tracks == tracks
    assert tracks


def test_only_states_up_to_the_scan_count_and_motion_is_held() -> None:
    odometry = ScanOdometry()
    for time_s, speed_mps in ((1.0, 4.0), (1.5, 8.0), (1.1, 4.0)):
        odometry.add(VehicleState(stamp_ns=round(time_s * 1e9), speed_mps=speed_mps))
    place = odometry.at(1_400_000_000)
    assert place is not None
    # 0.1 s between the first two, 0.3 s on at the same speed; the one at 1.5 s is not looked at
    assert (place.odom_from_vehicle.x_m, place.speed_mps) == pytest.approx((1.6, 4.0))
    assert odometry.at(1_400_000_000) == place
    later = odometry.at(1_500_000_000)
    assert later is not None
    assert later.odom_from_vehicle.x_m == pytest.approx(0.4 + 0.4 * 6.0)


def test_without_any_state_the_radar_stands_and_with_a_silent_bus_nothing_is_followed() -> None:
    odometry = ScanOdometry()
    assert odometry.at(START_NS) == stationary_pose()
    odometry.add(VehicleState(stamp_ns=START_NS + 1, valid=False))
    assert odometry.at(START_NS) == stationary_pose()
    assert odometry.at(START_NS + PERIOD_NS) is None
    odometry.add(VehicleState(stamp_ns=START_NS + 2 * PERIOD_NS))
    place = odometry.at(START_NS + 2 * PERIOD_NS)
    assert place is not None
    assert place.frame != stationary_pose().frame


def test_a_clock_that_was_set_back_begins_anew() -> None:
    odometry = ScanOdometry()
    for stamp_ns in (100_000_000_000, 100_200_000_000):
        odometry.add(VehicleState(stamp_ns=stamp_ns, speed_mps=9.0))
    before = odometry.at(100_100_000_000)
    odometry.add(VehicleState(stamp_ns=1_000_000_000, speed_mps=2.0))
    after = odometry.at(1_100_000_000)
    assert before is not None
    assert after is not None
    assert after.frame == before.frame + 1
    assert after.odom_from_vehicle.x_m == pytest.approx(0.2)
    # what waited from before is gone: nothing is known of that time
    assert odometry.at(100_200_000_000) is None


def test_states_without_scans_do_not_pile_up() -> None:
    """A radar that is off for a minute: the pose is that of all states, what waits is bounded."""
    ours, plain = ScanOdometry(), Odometry()
    stamps_ns = range(0, 3 * MAX_WAITING_STATES * STATE_NS, STATE_NS)
    every = [VehicleState(stamp_ns=ns, speed_mps=3.0, yaw_rate_rps=0.1) for ns in stamps_ns]
    for state in every:
        ours.add(state)
        plain.add(state)
    assert len(ours._waiting) == MAX_WAITING_STATES
    assert ours.at(every[-1].stamp_ns) == plain.at(every[-1].stamp_ns)


def test_the_mounting_travels_with_the_map() -> None:
    """One fact, one place: what the map was formed with is what the geometry stage follows objects with."""
    mounted = Pose2(2.0, 0.5, 0.4)
    player = scene_player(Params(scene="launch/scenes/corner.yaml", chirps_per_beam=4, effects="basic"))
    detector = CfarDetector(player.setup)
    former = RaFormer(player.setup, FormingParams(vehicle_from_radar=mounted))
    (ra_map,) = [one for index in range(25) for one in former.add(player.beam(0, index))]
    assert ra_map.vehicle_from_radar == mounted
    assert detector.detect(ra_map).vehicle_from_radar == mounted


def passed(number: int, speed_mps: float, ego_compensated: bool) -> Peaks:
    """The same world from a radar that drives straight ahead, measured 0.15 s after the scan's stamp: as seen from
    where it was at the stamp, or from where it is then.
    """
    one, later_s = scan(number), 0.15
    driven_m = speed_mps * (1e-9 * number * PERIOD_NS + (0.0 if ego_compensated else later_s))
    range_m, azimuth_rad = polar_from_xy(xy_from_polar(one.range_m, one.azimuth_rad) - [driven_m, 0.0])
    return msgspec.structs.replace(
        one,
        range_m=range_m,
        azimuth_rad=azimuth_rad,
        peak_stamp_ns=one.peak_stamp_ns + round(1e9 * later_s),
        ego_compensated=ego_compensated,
    )


@pytest.mark.parametrize("speed_mps", [0.0, 4.0])
def test_tracks_do_not_depend_on_whether_a_map_had_its_ego_motion_taken_out(speed_mps: float) -> None:
    """Its objects are 0.6 m nearer at 4 m/s where it had not. Tolerance: covariances follow the range, 5 cm."""

    def tracks(ego_compensated: bool) -> list[tuple[float, float, float]]:
        stage = ViewStage()
        for state in states():
            stage.add_state(msgspec.structs.replace(state, speed_mps=speed_mps, yaw_rate_rps=0.0))
        views = [stage.view(passed(number, speed_mps, ego_compensated)) for number in range(SCANS)]
        return [(track.x_m, track.y_m, track.velocity_x_mps) for track in views[-1].tracks]

    (compensated,), (uncompensated,) = tracks(True), tracks(False)
    assert uncompensated == pytest.approx(compensated, abs=0.05)


def test_the_side_street_can_be_launched() -> None:
    """The launch file's nodes take their parameters, and its drive is a scene that moves."""
    launch = read_launch_file(Path("launch/side_street.yaml"))
    params = msgspec.convert(launch.nodes["player"].params, Params)
    assert scene_player(msgspec.structs.replace(params, chirps_per_beam=2)).scene.moves
