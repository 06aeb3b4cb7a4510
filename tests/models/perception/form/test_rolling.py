"""Maps of the newest sweep every few beams: against whole scans, geometry, and beams folded for another pose.

Layout as in `test_ra_forming`: a quarter of the default sample rate, far points on the horizon.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import BeamFolder, FormingParams, ego_correction, moved_profile
from models.perception.form.sweep import LOBE_BEAMS
from models.physics.waveform import beat_samples
from msgs.values.radar import PRESETS, RadarBeam, RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.vehicle import VehicleState, ego_motion
from tests.models.perception.form.test_ra_forming import RADAR, SETUP, STAMP_NS, _beam, _codes, _peak, _scan

PERIOD_NS, INTERVAL_NS = 300_000_000, SETUP.beam_interval_ns
MOVING = VehicleState(stamp_ns=0, speed_mps=6.0, yaw_rate_rps=0.1)
TURNING = VehicleState(stamp_ns=0, speed_mps=0.0, yaw_rate_rps=0.1)


def maps_of(beams: list[RadarBeam], state: VehicleState | None = None, **params: Any) -> list[RangeAzimuthMap]:
    """All maps that beams bring."""
    former = RaFormer(SETUP, FormingParams(**params))
    return [formed for beam in beams for formed in former.add(beam, state)] + former.flush()


def scans(count: int, point_m: tuple[float, float], motion: VehicleState | None = None) -> list[RadarBeam]:
    return [
        beam
        for scan in range(count)
        for beam in _scan(SETUP, point_m, noise_power_mw=RADAR.noise_power_mw, motion=motion, scan_id=scan)
    ]


@pytest.mark.parametrize("state", [None, MOVING])
def test_whole_scans_among_rolling_ones_are_those_without(state: VehicleState | None) -> None:
    """Every fifth map holds the beams of one scan: the same bytes, but for what it says of them."""
    beams = scans(3, (28.0, 9.0), state)
    rolling, whole = maps_of(beams, state, rolling_beams=5), maps_of(beams, state)
    assert len(rolling) == 1 + 5 + 5
    again = [formed for formed in rolling if any(formed.stamp_ns == other.stamp_ns for other in whole)]
    for formed, other in zip(again, whole, strict=True):
        assert np.array_equal(formed.values, other.values)
        assert (formed.settled_stamp_ns, other.settled_stamp_ns) == (formed.stamp_ns + 24 * INTERVAL_NS, None)
        assert (formed.scan_id, formed.noise_power_mw) == (other.scan_id, other.noise_power_mw)


def test_a_scene_at_rest_gives_the_same_map_whatever_beam_is_the_newest() -> None:
    """Noise-free beams that repeat scan by scan: a map of two sweeps holds the values of either, at stamps of its own.

    Values to 1e-6 of the largest: products of complex64 matrices in the same order, nothing else differs.
    """
    beams = [beam for scan in range(2) for beam in _scan(SETUP, (28.0, 9.0), scan_id=scan)]
    first, *later = maps_of(beams, rolling_beams=5)
    for step, formed in enumerate(later, 1):
        assert np.abs(formed.values - first.values).max() <= 1e-6 * np.abs(first.values).max()
        assert np.array_equal(formed.incoherent, first.incoherent)
        oldest_ns = STAMP_NS + 5 * step * INTERVAL_NS
        assert (formed.stamp_ns, formed.scan_id) == (oldest_ns, 1)
        assert formed.azimuth_stamp_ns.min() == oldest_ns
        assert formed.azimuth_stamp_ns.max() == oldest_ns + 24 * INTERVAL_NS


def test_an_azimuth_between_the_newest_and_the_oldest_beam_has_the_stamp_of_the_nearer() -> None:
    """After beam 4 of the second scan -40 deg is new and -35 deg is old: half-way, no stamp lies between the two."""
    beams = [beam for scan in range(2) for beam in _scan(SETUP, (28.0, 9.0), scan_id=scan)][:30]
    formed = maps_of(beams, rolling_beams=5)[1]
    old_ns = STAMP_NS + 5 * INTERVAL_NS
    seam = (formed.grid.azimuth_rad > np.radians(-40.0)) & (formed.grid.azimuth_rad < np.radians(-35.0))
    upper = formed.grid.azimuth_rad[seam] > np.radians(-37.5)
    assert upper.any()
    assert not upper.all()
    assert np.array_equal(formed.azimuth_stamp_ns[seam], np.where(upper, old_ns, old_ns + 24 * INTERVAL_NS))


def test_what_is_settled_has_its_neighbours_and_no_map_settles_it_again() -> None:
    """Each map settles up to two beams before its newest, a whole scan up to its last: 25 beams a period."""
    formed = maps_of(scans(3, (28.0, 9.0)), rolling_beams=5)
    settled_stamp_ns = [item.settled_stamp_ns or 0 for item in formed]
    newest_ns = [int(item.azimuth_stamp_ns.max()) for item in formed]
    lags = [(newest - settled) // INTERVAL_NS for newest, settled in zip(newest_ns, settled_stamp_ns, strict=True)]
    assert lags == [0, *2 * [*4 * [LOBE_BEAMS], 0]]
    assert all(later > earlier for earlier, later in pairwise(settled_stamp_ns))


def _is_settled(formed: RangeAzimuthMap, stamp_ns: int) -> bool:
    """Whether the main lobe of a direction measured then holds beams of one sweep alone."""
    assert formed.settled_stamp_ns is not None
    if formed.settled_stamp_ns == formed.stamp_ns + 24 * INTERVAL_NS:
        return True
    return formed.stamp_ns + LOBE_BEAMS * INTERVAL_NS <= stamp_ns <= formed.settled_stamp_ns


@pytest.mark.parametrize("azimuth_deg", [-40.0, 5.0, 40.0])
@pytest.mark.parametrize("state", [MOVING, TURNING])
def test_two_sweeps_of_a_moving_radar_are_one_scene(azimuth_deg: float, state: VehicleState) -> None:
    """A static point 30 m away while the radar drives 1.8 m and turns 1.7 deg a scan, or turns 1.7 deg on the spot:
    every map has it where the pose of its oldest beam has it, and on the spot its range bin stays coherent.

    Known bias on the spot: a peak lies up to half a cell (0.24 deg) off, and beams 3 % closer: 0.5 deg; where beams of
    both sweeps hold the echo, by what was turned between the two more, 1.7 deg: not settled yet. While driving
    a beam is moved by what its axis asks: an echo 5 deg off it by up to 1.7 m sin(40 deg) sin(5 deg) = 0.1 m, half a
    bin, too far on one side and too short on the other. Loud ranges fall back to magnitudes, and an echo between two
    bins lies up to half a beam spacing off: 2.5 deg.
    """
    azimuth_rad = np.radians(azimuth_deg)
    point_m = (30.0 * np.cos(azimuth_rad), 30.0 * np.sin(azimuth_rad))
    for formed in maps_of(scans(2, point_m, state), state, rolling_beams=5):
        start = ego_motion(state.speed_mps, state.yaw_rate_rps, 1e-9 * (formed.stamp_ns - STAMP_NS))
        x_m, y_m = start.inverse().apply(np.array(point_m))
        row, column = _peak(formed)
        assert formed.grid.range_m[row] == pytest.approx(np.hypot(x_m, y_m), abs=formed.grid.range_bin_m)
        is_settled = _is_settled(formed, int(formed.azimuth_stamp_ns[column]))
        limit_deg = 2.5 if state is MOVING else 0.5 if is_settled else 2.2
        assert np.degrees(formed.grid.azimuth_rad[column] - np.arctan2(y_m, x_m)) == pytest.approx(0.0, abs=limit_deg)
        assert formed.ego_compensated
        assert state is MOVING or not formed.incoherent[row]


@pytest.mark.parametrize(("at_s", "to_s"), [(0.1, -0.15), (0.05, 0.3)])
def test_a_profile_is_carried_to_another_pose_as_its_samples_would_be(at_s: float, to_s: float) -> None:
    """Echoes of 20 codes to full scale at 10 to 102 m, moved by 2.4 m after the transform instead of before it.

    Between bin 20 and 490 to 1e-5 of the strongest: what is beyond the edges is missing and falls off as the side lobes
    of the Hann window do, 1e-5 within 20 bins.
    """
    folder = BeamFolder(SETUP, FormingParams(), RangeAzimuthGrid())
    state = VehicleState(stamp_ns=0, speed_mps=12.0, yaw_rate_rps=0.1)
    levels = {10.3: 1e-1, 33.2: 1e-2, 70.1: 3e-3, 101.7: 1e-3}
    beat = sum(level * beat_samples(RADAR, 2.0 * np.array([range_m])) for range_m, level in levels.items())
    beat = np.broadcast_to(beat, (RADAR.chirps_per_beam, RADAR.samples_per_chirp))
    beam = _beam(SETUP, 5, _codes(SETUP, beat, RADAR.noise_power_mw, 0))
    at, to = (ego_correction(folder, 5, time_s, state) for time_s in (at_s, to_s))
    carried = moved_profile(folder, folder.fold(beam, at).profile, at.shift_m, to.shift_m)
    wanted = folder.fold(beam, to).profile
    assert np.abs(carried - wanted)[20:490].max() <= 1e-5 * np.abs(wanted).max()
    assert np.abs(wanted - folder.fold(beam, at).profile).max() > 0.1 * np.abs(wanted).max()


def test_maps_roll_only_on_from_the_sweep_before() -> None:
    """A scan left out, or ego motion that is known of one sweep alone: whole scans, until two follow each other."""
    beams = scans(4, (28.0, 9.0))
    torn = [beam for beam in beams if beam.scan_id != 1]
    assert [formed.scan_id for formed in maps_of(torn, rolling_beams=12)] == [0, 2, 3, 3, 3]
    former = RaFormer(SETUP, FormingParams(rolling_beams=12))
    states = {0: None, 1: MOVING, 2: MOVING}
    formed = [item for beam in beams[:75] for item in former.add(beam, states[beam.scan_id])]
    assert [item.scan_id for item in formed] == [0, 1, 2, 2, 2]


def test_a_lost_beam_is_missing_until_it_is_measured_again() -> None:
    """Beam 7 of the first scan: of the maps of the second, only those that still hold the first scan's lack it."""
    beams = [beam for beam in scans(2, (28.0, 9.0)) if (beam.scan_id, beam.beam_index) != (0, 7)]
    formed = maps_of(beams, rolling_beams=5)
    assert [item.missing_beams for item in formed] == [(7,), (7,), (), (), (), ()]


def test_every_other_beam_rolls_too() -> None:
    """Of 13 beams in use, with a map each 12 beams of the radar: after beams 10, 22 and the last."""
    formed = maps_of(scans(2, (28.0, 9.0)), rolling_beams=12, beam_step=2)
    newest = [(int(item.azimuth_stamp_ns.max()) - STAMP_NS) // INTERVAL_NS for item in formed]
    assert newest == [24, 25 + 10, 25 + 22, 25 + 24]


@pytest.mark.parametrize("value", [0, -5])
def test_steps_that_are_none_are_refused(value: int) -> None:
    with pytest.raises(ValueError, match="rolling_beams must be finite and positive"):
        FormingParams(rolling_beams=value)


def test_a_digital_array_has_nothing_to_roll() -> None:
    with pytest.raises(ValueError, match="rolling_beams must be null for a digital array"):
        RaFormer(PRESETS["77ghz"], FormingParams(rolling_beams=5))
