"""Receiver: what is drawn of a beam's spurs."""

from __future__ import annotations

import numpy as np

from sim_player.scene.front_end import Spur
from sim_player.signal.receiver import spur_turns


def test_spurs_begin_every_beam_at_a_phase_of_its_seed() -> None:
    """Free of the beams: the same again for a beam, others for the next one, uniform over 1,000 of them."""
    spurs = [Spur(frequency_hz=1e6, power_dbm=-60.0)] * 3
    turns = np.array([spur_turns(spurs, [5, beam]) for beam in range(1000)])
    np.testing.assert_array_equal(turns[7], spur_turns(spurs, [5, 7]))
    assert len(np.unique(turns)) == 3000
    # the mean phasor of n uniform phases is of the order of 1 / sqrt(n)
    assert abs(np.exp(2j * np.pi * turns).mean()) < 4.0 / np.sqrt(3000)
