"""Signal effects: one is absent where its switch changes nothing."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from models.physics.antenna import setup_weights
from msgs.values.radar import ArrayParams, RadarSetup
from sim_player.scene.description import Scene, SceneRadar
from sim_player.scene.front_end import FrontEnd, Spur
from sim_player.scene.world import World, prepare
from sim_player.signal.absences import no_coupling, no_flicker, no_iq_imbalance, no_leakage, no_phase_steps, no_spurs
from sim_player.signal.switches import IDEAL, SignalEffects, column_weights
from tests.sim_player.trace.point_scenes import wall

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


@pytest.mark.parametrize(
    ("effect", "stated", "reason"),
    [
        (no_coupling, FrontEnd(coupling_db=-20.0), "the columns do not couple"),
        (no_flicker, FrontEnd(flicker_corner_hz=1e4), "the receiver has no 1/f noise"),
        (no_leakage, FrontEnd(leakage_dbm=-40.0), "no leakage is stated"),
        (no_iq_imbalance, FrontEnd(iq_gain_db=0.5), "I and Q agree"),
        (no_iq_imbalance, FrontEnd(iq_phase_deg=2.0), "I and Q agree"),
        (no_spurs, FrontEnd(spurs=(Spur(frequency_hz=1e6, power_dbm=-60.0),)), "no spurs are stated"),
    ],
)
def test_an_effect_of_the_front_end_is_there_where_it_is_stated(
    effect: Callable[[World], str | None], stated: FrontEnd, reason: str
) -> None:
    """The ideal front end has none of them; one stated value brings its own effect."""
    scene = Scene(name="wall", surfaces=(wall((12.0, -5.0), (12.0, 8.0)),))
    assert effect(prepare(scene)) == reason
    assert effect(prepare(msgspec.structs.replace(scene, radar=SceneRadar(front_end=stated)))) is None
