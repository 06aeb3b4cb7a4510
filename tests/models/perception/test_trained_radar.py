"""Set-ups beside the radar that a network was trained for."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from models.perception.trained_radar import TrainedRadar
from msgs.values.radar import PRESETS, ArrayParams, BeamGrid, RadarParams, RadarSetup

WAVELENGTH_M = RadarParams().wavelength_m


def steered(*azimuth_deg: float) -> RadarSetup:
    return RadarSetup(beams=BeamGrid(azimuth_deg=azimuth_deg))


@pytest.mark.parametrize(
    ("setup", "different"),
    [
        (RadarSetup(), []),
        # more beams, half of them, another order, another set of chirps: every direction is looked at as closely
        (steered(*np.arange(-60.0, 60.1, 2.5)), []),
        (steered(*range(60, -61, -10)), []),
        (RadarSetup(radar=RadarParams(chirps_per_beam=1, carrier_hz=9.4e9)), []),
        (steered(*range(-50, 51, 5)), ["no beam within 5 deg of 2 of 25 directions"]),
        (steered(*range(-60, 61, 20)), ["no beam within 5 deg of 6 of 25 directions"]),
        (steered(20.0), ["no beam within 5 deg of 22 of 25 directions"]),
        (steered(20.0, 20.0), ["no beam within 5 deg of 22 of 25 directions"]),
        (RadarSetup(array=ArrayParams(columns=6)), ["columns 6 in place of 8"]),
        (RadarSetup(array=ArrayParams(column_spacing_m=0.7 * WAVELENGTH_M)), ["column_spacing 0.7 in place of 0.5"]),
        (RadarSetup(array=ArrayParams(steered_ways=1)), ["steered_ways 1 in place of 2"]),
        (RadarSetup(array=ArrayParams(phase_bits=2)), []),
        (RadarSetup(array=ArrayParams(phase_bits=1)), ["phase_bits 1 in place of 6"]),
        (RadarSetup(radar=RadarParams(carrier_hz=24e9)), ["carrier_hz 2.4e+10 in place of 1e+10"]),
    ],
)
def test_differences(setup: RadarSetup, different: list[str]) -> None:
    assert TrainedRadar().differences(setup) == different


def test_beams_that_are_not_asked_for_do_not_look() -> None:
    setup = RadarSetup()
    assert TrainedRadar().differences(setup, tuple(range(1, 25, 2))) == []
    assert TrainedRadar().differences(setup, tuple(range(13))) == ["no beam within 5 deg of 12 of 25 directions"]
    assert TrainedRadar().differences(setup, tuple(range(25))) == ["no beam within 5 deg of 25 of 25 directions"]


@pytest.mark.parametrize("preset", PRESETS)
def test_a_radar_is_like_itself_as_its_card_has_it(preset: str) -> None:
    setup = PRESETS[preset]
    card = msgspec.json.decode(msgspec.json.encode(TrainedRadar.of(setup)), type=TrainedRadar)
    assert card.differences(setup) == []
    assert (card == TrainedRadar()) == (preset == "xband")
