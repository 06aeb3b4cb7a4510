"""The chain of all stages: what it is made of reaches its views."""

from __future__ import annotations

import numpy as np

from models.perception.form.ra_forming import FormingParams
from msgs.values.radar import RadarBeam, RadarParams, RadarSetup
from tests.builders import cfar_chain, example_beam

SETUP = RadarSetup(radar=RadarParams(chirps_per_beam=2))


def noise_beams() -> list[RadarBeam]:
    rng, radar = np.random.default_rng(0), SETUP.radar
    return [
        example_beam(
            stamp_ns=index * SETUP.beam_interval_ns,
            beam_index=index,
            azimuth_rad=float(SETUP.beams.azimuth_rad[index]),
            samples=rng.integers(-60, 60, (2, radar.samples_per_chirp, 2)).astype(np.int16),
            full_scale_dbm=SETUP.full_scale_dbm,
        )
        for index in range(25)
    ]


def test_maps_are_formed_as_the_parameters_say() -> None:
    """Every fifth of 25 beams: 0, 5, 10, 15 and 20 are used, which beam 20 completes; unless told, all are."""
    for forming, last, used in ((FormingParams(beam_step=5), 20, range(0, 25, 5)), (None, 24, range(25))):
        chain = cfar_chain(SETUP, forming)
        views = [chain.add(beam) for beam in noise_beams()]
        assert [index for index, some in enumerate(views) if some] == [last]
        assert set(range(25)) - set(views[last][0].ra_map.unused_beams) == set(used)
