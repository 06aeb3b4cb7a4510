"""The compiled sum of a moving beam against the one in double precision, term by term joined over the chirps."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from msgs.values.radar import ArrayParams, RadarParams, RadarSetup
from sim_player.signal.compiled_beats import compiled_terms, decimation
from sim_player.signal.fmcw import slow_time_table, slow_time_terms
from sim_player.signal.levels import Terms, echo_beats, echo_terms
from sim_player.signal.swept_echoes import moving_echoes
from sim_player.signal.switches import IDEAL, PLAIN, SignalEffects
from sim_player.trace.paths import Paths
from tests.sim_player.signal.references import ALL
from tests.sim_player.signal.test_levels import FAULTS, OVERLAP, SMALL, chirp_span_m, some_paths

BEAM = 9
RADAR = RadarSetup().radar


def samples_of(terms: Terms) -> np.ndarray:
    """All chirps of a beam, complex [chirps, samples]."""
    beats, carrier, basis = terms
    return np.asarray((carrier[:, None] * basis.T) @ beats)


def reference(setup: RadarSetup, paths: Paths, effects: SignalEffects) -> np.ndarray:
    echoes, carrier, basis = moving_echoes(setup, paths, effects, FAULTS, BEAM)
    return samples_of((echo_beats(echoes), carrier, basis))


def largest_error(setup: RadarSetup, paths: Paths, effects: SignalEffects) -> float:
    """Over the largest sample."""
    got, wanted = samples_of(compiled_terms(setup, paths, effects, FAULTS, BEAM)), reference(setup, paths, effects)
    return float(np.abs(got - wanted).max() / np.abs(wanted).max())


@pytest.mark.parametrize("two_ways", [False, True])
@pytest.mark.parametrize(
    "effects",
    [
        IDEAL,
        PLAIN,
        SignalEffects(element_pattern=False),
        SignalEffects(mutual_coupling=True, quantised_phases=False),
        SignalEffects(squint=True),
        SignalEffects(chirp_overlap=True),
        SignalEffects(range_migration=True),
        ALL,
    ],
    ids=["ideal", "plain", "isotropic", "coupling", "squint", "overlap", "migration", "all"],
)
def test_the_compiled_sum_is_that_in_double_precision(effects: SignalEffects, two_ways: bool) -> None:
    """40 echoes up to 13 % of the chirp at up to 20 m/s. Bias: kernels to 1e-5 each, straight lines over a 128th of
    the chirp at its start: 1e-4 of the largest sample.
    """
    paths = some_paths(40, chirp_span_m(SMALL, OVERLAP), two_ways=two_ways, speed_mps=20.0)
    assert largest_error(SMALL, paths, effects) < 1e-4


@pytest.mark.parametrize("effects", [PLAIN, ALL], ids=["plain", "all"])
@pytest.mark.parametrize("steered_ways", [1, 2])
def test_the_default_radar_and_one_that_steers_receive_alone(effects: SignalEffects, steered_ways: int) -> None:
    """300 echoes up to 90 m of path at up to 30 m/s, 8,192 samples a chirp: 1e-4 of the largest sample."""
    setup = RadarSetup(
        radar=msgspec.structs.replace(RADAR, chirps_per_beam=16), array=ArrayParams(steered_ways=steered_ways)
    )
    assert largest_error(setup, some_paths(300, 90.0, two_ways=True, speed_mps=30.0), effects) < 1e-4


def test_long_beams_keep_their_slow_time() -> None:
    """1,024 chirps at +-30 m/s turn by 11 turns: as many terms as the reference has, the same sum to 1e-4."""
    setup = RadarSetup(radar=RadarParams(samples_per_chirp=512, chirps_per_beam=1024))
    paths = some_paths(20, 5.0, speed_mps=30.0)
    assert largest_error(setup, paths, PLAIN) < 1e-4
    assert compiled_terms(setup, paths, PLAIN, FAULTS, BEAM)[0].dtype == np.complex64


def test_the_last_chirps_echo_counts_where_it_passes_the_low_pass() -> None:
    """A band of half the rate: at 13 % of the chirp the last chirp's tone lies 0.43 of the rate off, under 1/2.

    With twice the band it lies beyond and is gone; in both the compiled sum has what the reference has.
    """
    for bandwidth_hz in (0.5 * SMALL.radar.sample_rate_hz, SMALL.radar.sample_rate_hz):
        setup = RadarSetup(radar=msgspec.structs.replace(SMALL.radar, bandwidth_hz=bandwidth_hz))
        paths = some_paths(20, chirp_span_m(setup, OVERLAP))
        assert decimation(setup.radar, paths.length_m)
        assert largest_error(setup, paths, SignalEffects(chirp_overlap=True)) < 1e-4


def test_too_wide_a_band_is_refused_and_summed_in_full() -> None:
    """Echoes over the whole band: no low rate holds them. `echo_terms` sums them the exact way."""
    setup = RadarSetup(radar=msgspec.structs.replace(SMALL.radar, bandwidth_hz=SMALL.radar.sample_rate_hz))
    paths = some_paths(10, chirp_span_m(setup, 0.9))
    assert decimation(setup.radar, paths.length_m) == 0
    with pytest.raises(ValueError, match="must leave half of the sampled band free"):
        compiled_terms(setup, paths, PLAIN, FAULTS, BEAM)
    got = samples_of(echo_terms(setup, paths, PLAIN, FAULTS, BEAM, "float32"))
    wanted = reference(setup, paths, PLAIN)
    assert np.abs(got - wanted).max() < 1e-4 * np.abs(wanted).max()


@pytest.mark.parametrize("effects", [PLAIN, ALL], ids=["plain", "all"])
def test_no_paths_are_silence(effects: SignalEffects) -> None:
    beats, _, _ = compiled_terms(SMALL, some_paths(0, 1.0), effects, FAULTS, BEAM)
    assert not beats.any()


def test_the_same_paths_give_the_same_bytes() -> None:
    paths = some_paths(40, 6.0, speed_mps=20.0)
    first, second = (compiled_terms(SMALL, paths, ALL, FAULTS, BEAM)[0].tobytes() for _ in range(2))
    assert first == second


@pytest.mark.parametrize("speeds_mps", [(0.0,), (5.0, 5.0), (-30.0, 3.0, 30.0)])
def test_the_table_of_shares_is_what_the_terms_are(speeds_mps: tuple[float, ...]) -> None:
    """exp(j w c) from both, to the slow-time tolerance; the table's own turns and any between them."""
    speed = np.array(speeds_mps)
    turn = 4.0 * np.pi * speed * RADAR.chirp_period_s / RADAR.wavelength_m
    carrier, basis, share = slow_time_terms(RADAR, speed)
    table = slow_time_table(RADAR, turn)
    np.testing.assert_array_equal(basis, table.basis)
    np.testing.assert_array_equal(carrier, table.carrier)
    place = (turn - table.middle_rad) / table.widest_rad if table.widest_rad else np.zeros_like(turn)
    shares = np.polynomial.chebyshev.chebval(place, table.series.T)
    np.testing.assert_allclose(shares, share, atol=1e-9 * np.abs(share).max())
