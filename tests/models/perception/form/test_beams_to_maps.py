"""The forming stage at its door: set-ups, clocks and states."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from models.perception.form.beams_to_maps import LONGEST_SCAN_NS, FormingStage
from models.perception.form.sweep import LOBE_BEAMS, Sweep, _indices, _shifted
from msgs.values.radar import BeamGrid, RadarBeam, RadarParams, RadarSetup
from msgs.values.vehicle import VehicleState
from tests.builders import beam_of

START_NS = 10**10
SETUP = RadarSetup(
    radar=RadarParams(samples_per_chirp=1024, chirps_per_beam=8), beams=BeamGrid(azimuth_deg=(-10.0, 0.0, 10.0))
)


def beam(scan: int, index: int, stamp_ns: int) -> RadarBeam:
    return beam_of(SETUP, index, np.ones((8, 1024, 2), np.int16), stamp_ns=stamp_ns, scan_id=scan, beam_count=3)


def test_a_beam_without_a_set_up_and_one_of_another_clock_are_refused() -> None:
    """Two seconds within a scan are its own, a nanosecond more is a clock that was set; the next scan is another."""
    stage = FormingStage()
    with pytest.raises(ValueError, match="beam 0 of scan 4 came before radar/setup"):
        stage.add(beam(4, 0, 0))
    stage.set_up(SETUP)
    assert stage.is_between_scans
    stage.add(beam(4, 0, START_NS))
    assert not stage.is_between_scans
    for later_ns, said in ((LONGEST_SCAN_NS + 1, r"\+2 s within scan 4"), (-LONGEST_SCAN_NS - 1, "-2 s within scan 4")):
        with pytest.raises(ValueError, match=said):
            stage.add(beam(4, 1, START_NS + later_ns))
    stage.add(beam(4, 1, START_NS + LONGEST_SCAN_NS))
    assert [ra_map.scan_id for ra_map in stage.add(beam(4, 2, START_NS + 24_000_000))] == [4]
    assert stage.is_between_scans
    stage.add(beam(5, 0, 100 * LONGEST_SCAN_NS))


def test_motion_is_that_of_the_newest_state_before_the_beam_if_it_is_valid() -> None:
    stage = FormingStage()
    for stamp_ns, speed_mps, valid in ((0, 1.0, True), (10, 2.0, True), (20, 3.0, False), (30, 4.0, True)):
        stage.add_state(VehicleState(stamp_ns=stamp_ns, speed_mps=speed_mps, valid=valid))
    speeds = [state and state.speed_mps for state in (stage._state_for(beam(0, 0, at)) for at in (9, 10, 19, 25, 35))]
    assert speeds == [1.0, 2.0, 2.0, None, 4.0]
    # states go on to a stage that takes over, and so does the radar
    stage.set_up(SETUP)
    later = FormingStage()
    later.take_over(stage)
    assert later.former is not None
    state = later._state_for(beam(0, 0, 35))
    assert state is not None
    assert state.speed_mps == 4.0


def test_a_background_of_its_own_is_in_place_of_the_set_ups() -> None:
    background = np.full((3, 1024), 2.0 + 1.0j, np.complex64)
    stage = FormingStage(background=background)
    stage.set_up(msgspec.structs.replace(SETUP, background=np.zeros((3, 1024), np.complex64)))
    assert stage.former is not None
    np.testing.assert_array_equal(stage.former.folder.setup.background, background)


@pytest.mark.parametrize(
    ("cells", "moved"), [(0, [1, 2, 3]), (1, [None, 1, 2]), (-1, [2, 3, None]), (2, [None, None, 1]), (3, [None] * 3)]
)
def test_speeds_move_along_range_and_leave_nothing_behind(cells: int, moved: list[float | None]) -> None:
    got = _shifted(np.array([1.0, 2.0, 3.0]), cells)
    np.testing.assert_array_equal(got, [np.nan if value is None else value for value in moved])


def test_a_sweep_follows_the_one_a_period_before_it() -> None:
    """Scan 5 after scan 4, its period later to within half of one."""
    period_ns = 300_000_000

    def sweep(scan: int, stamp_ns: int) -> Any:
        folder = SimpleNamespace(setup=SimpleNamespace(radar=SimpleNamespace(scan_period_s=0.3)))
        return SimpleNamespace(scan_id=scan, stamp_ns=stamp_ns, _folder=folder)

    last = sweep(4, 1000)
    follows = [
        Sweep._follows(sweep(scan, 1000 + round(share * period_ns)), last)
        for scan, share in ((5, 1.0), (5, 0.51), (5, 0.49), (5, 1.49), (5, 1.51), (6, 1.0), (4, 1.0))
    ]
    assert follows == [True, True, False, True, False, False, False]
    assert LOBE_BEAMS == 2
    assert _indices(np.array([True, False, True])) == (0, 2)
