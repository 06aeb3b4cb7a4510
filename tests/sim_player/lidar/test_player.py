"""A scene played as a LiDAR: stamps, repeatability, motion, truth, and the shipped scene's car over ambient light."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from msgs.files.shipped import CHECKOUT
from msgs.values.perception import PathClass
from sim_player.lidar.player import BLOCK, LidarPlayer
from sim_player.lidar.spad import LightRoute
from sim_player.paths.ray_tracing import trace
from sim_player.paths.truth import scene_truth
from sim_player.scene.description import Scene, load_scene
from sim_player.scene.world import prepare
from tests.sim_player.lidar.references import expected_histograms

FOLDER = CHECKOUT / "launch" / "scenes"


def hidden_car(speed_mps: float = 0.0, ego_mps: float = 0.0) -> Scene:
    scene = load_scene(FOLDER / "hidden_car_spad.yaml")
    moving = msgspec.structs.replace(scene.objects[0], speed_mps=speed_mps)
    return msgspec.structs.replace(scene, objects=(moving,), ego=msgspec.structs.replace(scene.ego, speed_mps=ego_mps))


def test_stamps_of_scans_and_azimuths() -> None:
    """0.3 s a scan, 1.171875 ms an azimuth."""
    player = LidarPlayer(hidden_car(), start_ns=1_000)
    assert player.setup.stamp_ns == 1_000
    assert player.stamp_ns(2, 4) == 1_000 + 600_000_000 + 4_687_500
    scan = player.scan(2)
    assert (scan.stamp_ns, scan.scan_id) == (600_001_000, 2)
    assert scan.counts.shape == (256, 512)
    assert scan.counts.dtype == np.uint32
    np.testing.assert_array_equal(scan.azimuth_stamp_ns, [player.stamp_ns(2, azimuth) for azimuth in range(256)])
    assert scan.counts.sum(axis=1).max() <= player.setup.spad.pulses
    assert player.vehicle_state(5).stamp_ns == 5


@pytest.mark.slow
@pytest.mark.parametrize("speed_mps", [0.0, 5.0])
def test_same_seed_same_bytes_in_any_order(speed_mps: float) -> None:
    one, other = (LidarPlayer(hidden_car(speed_mps), seed=3) for _ in range(2))
    first = [one.scan(scan).counts for scan in (0, 1)]
    second = [other.scan(scan).counts for scan in (1, 0)]
    np.testing.assert_array_equal(first[0], second[1])
    np.testing.assert_array_equal(first[1], second[0])
    assert not np.array_equal(*first)
    assert not np.array_equal(first[0], LidarPlayer(hidden_car(speed_mps), seed=4).scan(0).counts)


@pytest.mark.parametrize("start_ns", [0, 1_763_750_000_123_456_789])
def test_what_moves_moves_within_a_scan(start_ns: int) -> None:
    """At -36 deg (azimuth 51) the image of the car's near face, x = 25.1 m, lies 25.1 m / cos 36 deg away.

    A vehicle that drives at 8 m/s is 0.45 m on when that block starts, 48 measurements of 1.171875 ms into the scan,
    whatever the clock says when the scene starts.
    """

    def car_at_51(ego_mps: float, scan: int) -> float:
        paths = LidarPlayer(hidden_car(ego_mps=ego_mps), start_ns=start_ns).paths(scan)
        car = (paths.object_index == 0) & (paths.route == LightRoute.MIRROR) & (paths.azimuth_index == 51)
        return float(paths.range_m[car][0])

    cosine = np.cos(np.radians(36.0))
    assert BLOCK * (51 // BLOCK) == 48
    assert car_at_51(0.0, 0) == pytest.approx(25.1 / cosine, abs=1e-9)
    assert car_at_51(8.0, 0) == pytest.approx((25.1 - 8.0 * 48 * 1.171875e-3) / cosine, abs=1e-7)


def test_truth_is_the_radars() -> None:
    scene = hidden_car(speed_mps=2.0)
    player, world = LidarPlayer(scene), prepare(scene)
    truth = player.truth(1)
    same = scene_truth(world, scene.setup, trace(world, 0.3), 0.3, truth.stamp_ns, 1)
    np.testing.assert_array_equal(truth.mirrored_points_m, same.mirrored_points_m)
    assert truth.objects == same.objects
    assert truth.objects[0].hidden
    assert truth.stamp_ns == 300_000_000


def test_the_hidden_car_stands_over_the_ambient_light() -> None:
    """In every azimuth of its image, in its two best bins, at least 7 expected counts over 2.2 of all else together.

    The image of its near face: x 25.1 m, y -17.75..-22.25 m: 30.74 m to 33.54 m. A pulse may lie on a bin's edge.
    """
    player = LidarPlayer(hidden_car())
    paths = player.paths(0)
    car = paths.take((paths.object_index == 0) & (paths.kind == PathClass.MIRRORED))
    assert 30.7 < car.range_m.min() < car.range_m.max() < 33.6
    azimuths = np.unique(car.azimuth_index)
    assert len(azimuths) == 17

    def pairs(counts: np.ndarray) -> np.ndarray:
        return counts[azimuths, :-1].astype(float) + counts[azimuths, 1:]

    every = pairs(expected_histograms(player.setup, paths))
    dark = pairs(expected_histograms(player.setup, paths.take(paths.object_index < 0)))
    rows, best = np.arange(17), (every - dark).argmax(axis=1)
    assert (every - dark)[rows, best].min() > 7.0
    assert dark[rows, best].max() < 2.2
    drawn, mean = pairs(player.scan(0).counts)[rows, best].sum(), every[rows, best].sum()
    assert abs(drawn - mean) < 5.0 * np.sqrt(mean)


@pytest.mark.parametrize(
    ("was", "becomes", "rule"),
    [
        ("gates: 2", "bins: 1000000000", "radar.spad: spad.bins must lie in 1..16384, got 1000000000"),
        ("gates: 2", "divergence_rad: 1.0e+300", "spad.divergence_rad must lie in 1e-09..3.14159, got 1e.300"),
        ("1.171875e-3", "1.0e+2", "radar.spad_scan_period_s: lidar.scan_period_s must be no shorter than 256 meas"),
        ("period_s: 0.3", "period_s: 1.0e+300", "radar.spad_scan_period_s: .* no longer than 1e.06 s"),
    ],
)
def test_a_file_that_asks_too_much_is_refused_in_a_line(tmp_path: Path, was: str, becomes: str, rule: str) -> None:
    file = tmp_path / "much.yaml"
    file.write_text((FOLDER / "hidden_car_spad.yaml").read_text().replace(was, becomes))
    with pytest.raises(ValueError, match=rf"^{file}: .*{rule}") as caught:
        load_scene(file)
    assert "\n" not in str(caught.value)


def test_refusals() -> None:
    scene = hidden_car()
    radar = msgspec.structs.replace(scene, radar=msgspec.structs.replace(scene.radar, preset="xband"))
    with pytest.raises(ValueError, match=r"radar\.preset: must be 'spad' for a LiDAR, got 'xband'"):
        LidarPlayer(radar)
    with pytest.raises(ValueError, match="seed must not be negative, got -1"):
        LidarPlayer(scene, seed=-1)
    with pytest.raises(ValueError, match="scan must not be negative, got -2"):
        LidarPlayer(scene).scan(-2)
