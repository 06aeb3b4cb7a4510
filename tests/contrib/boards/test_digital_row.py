"""A board's row as a digital array: which loops a gap costs, the order of the channels, the set-up's numbers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from contrib.boards.digital_row import _columns, beam_codes, beam_messages, lost_loops
from msgs.values.radar import ArrayParams, BeamGrid, RadarSetup, orthogonal_beams


@pytest.mark.parametrize(
    ("gap", "lost"),
    [((0, 100), [0]), ((99, 101), [0, 1]), ((100, 101), [1]), ((150, 301), [1, 2, 3]), ((399, 400), [3])],
)
def test_a_gap_costs_the_loops_that_it_touches(gap: tuple[int, int], lost: list[int]) -> None:
    """Four loops of 100 bytes; a gap is its first byte and the one after its last."""
    config: Any = SimpleNamespace(frame=SimpleNamespace(loops=4), frame_bytes=400)
    assert np.flatnonzero(lost_loops([gap], config)).tolist() == lost


def test_channels_are_ordered_from_right_to_left_half_a_wavelength_apart() -> None:
    def row(*halves: float) -> Any:
        return SimpleNamespace(channel_y_m=[0.002 * half for half in halves], wavelength_m=0.004)

    assert _columns(row(2.0, 0.0, 1.0)).tolist() == [1, 2, 0]
    for halves in ((0.0, 1.0, 3.0), (0.0, 1.0, 1.0), (0.0,)):
        with pytest.raises(ValueError, match="at least two channels half a wavelength apart"):
            _columns(row(*halves))


def test_beams_keep_the_level_of_noise() -> None:
    """Weights have unit power: eight columns of noise of 1000 codes give beams of 1000, an echo in phase 8 ** 0.5."""
    array = ArrayParams(columns=8, rows=1, phase_bits=0, steered_ways=1, digital=True)
    setup = RadarSetup(array=array, beams=BeamGrid(azimuth_deg=(0.0,)))
    noise = np.random.default_rng(48).normal(0.0, 1000.0, (4, 8, 4096, 2)).astype(np.float32)
    assert beam_codes(noise.view(np.complex64)[..., 0], setup).std() == pytest.approx(1000.0, rel=0.02)
    assert beam_codes(np.full((1, 8, 4), 1000.0, np.complex64), setup)[0, 0, 0].tolist() == [2828, 0]


def test_beams_of_a_frame_are_one_scan() -> None:
    array = ArrayParams(columns=4, rows=1, phase_bits=0, steered_ways=1, digital=True)
    setup = RadarSetup(array=array, beams=orthogonal_beams(4), full_scale_dbm=-11.0)
    beams = np.arange(4 * 2 * 3 * 2, dtype=np.int16).reshape(4, 2, 3, 2)
    messages = beam_messages(beams, setup, scan_id=7, stamp_ns=123)
    assert [(one.scan_id, one.beam_index, one.beam_count, one.stamp_ns) for one in messages] == [
        (7, index, 4, 123) for index in range(4)
    ]
    assert [one.azimuth_rad for one in messages] == setup.beams.azimuth_rad.tolist()
    assert {one.full_scale_dbm for one in messages} == {-11.0}
    np.testing.assert_array_equal([one.samples for one in messages], beams)
