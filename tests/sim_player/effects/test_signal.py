"""Signal effects: one is absent where its switch changes nothing."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from models.physics.antenna import setup_weights
from msgs.values.radar import ArrayParams, RadarSetup
from sim_player.effects.signal import no_phase_steps
from sim_player.scene.description import Scene
from sim_player.scene.front_end import FrontEnd
from sim_player.scene.world import prepare
from sim_player.signal.switches import IDEAL, SignalEffects, column_weights
from tests.sim_player.effects.point_scenes import wall

STEPPED = RadarSetup()
EXACT = RadarSetup(array=ArrayParams(phase_bits=0))
MEASURED = msgspec.structs.replace(STEPPED, steering_weights=setup_weights(STEPPED).astype(np.complex64))


@pytest.mark.parametrize(("setup", "is_absent"), [(STEPPED, False), (EXACT, True), (MEASURED, True)])
def test_phase_steps_are_absent_where_rounding_changes_no_weight(setup: RadarSetup, is_absent: bool) -> None:
    """Shifters of 6 bits; without steps; weights that were measured: these stand as they are, whatever the shifters."""
    stepped = column_weights(setup, SignalEffects(quantised_phases=True), FrontEnd())
    assert np.array_equal(stepped, column_weights(setup, IDEAL, FrontEnd())) == is_absent
    scene = Scene(name="wall", surfaces=(wall((12.0, -5.0), (12.0, 8.0)),))
    assert (no_phase_steps(prepare(scene, 0, setup)) is not None) == is_absent
