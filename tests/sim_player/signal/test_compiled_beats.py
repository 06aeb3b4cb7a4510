"""The compiled sum of a moving beam against the one in double precision, term by term joined over the chirps."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from lab.tradeoff.literal_signal import literal_echoes
from msgs.values.radar import ArrayParams, RadarParams, RadarSetup
from sim_player.planner.plan import SINGLE
from sim_player.scene.front_end import NO_FAULTS
from sim_player.signal.compiled_beats import decimation
from sim_player.signal.levels import Terms, echo_terms, group_beats, hann_profiles
from sim_player.signal.swept_echoes import TOLERANCE
from sim_player.signal.switches import IDEAL, PLAIN, SignalEffects
from sim_player.trace.path_table import Paths
from tests.sim_player.signal.references import ALL
from tests.sim_player.signal.test_levels import (
    FAULTS,
    OVERLAP,
    SMALL,
    STATIC,
    apart,
    chirp_span_m,
    one_path,
    some_paths,
)

BEAM = 9
RADAR = RadarSetup().radar


def samples_of(terms: Terms) -> np.ndarray:
    """All chirps of a beam, complex [chirps, samples]."""
    beats, carrier, basis = terms
    return np.asarray((carrier[:, None] * basis.T) @ beats)


def error_over_largest(got: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.abs(got - wanted).max() / np.abs(wanted).max())


def largest_error(setup: RadarSetup, paths: Paths, effects: SignalEffects) -> float:
    """Of single precision against double, which `test_levels` holds against the literal level."""
    single, double = (
        samples_of(echo_terms(setup, paths, effects, FAULTS, BEAM, precision)) for precision in ("float32", "float64")
    )
    return error_over_largest(single, double)


@pytest.mark.parametrize(
    ("effects", "two_ways"),
    [
        (IDEAL, False),
        (PLAIN, True),
        (SignalEffects(element_pattern=False), True),
        (SignalEffects(mutual_coupling=True, quantised_phases=False), False),
        (SignalEffects(squint=True), True),
        (SignalEffects(chirp_overlap=True), False),
        (SignalEffects(range_migration=True), True),
        (ALL, False),
        (ALL, True),
    ],
    ids=["ideal", "plain", "isotropic", "coupling", "squint", "overlap", "migration", "all", "all two ways"],
)
def test_the_compiled_sum_is_the_literal_one(effects: SignalEffects, two_ways: bool) -> None:
    """16 echoes up to 13 % of the chirp at up to 20 m/s, four chirps. Bias: kernels to 1e-5 each, straight lines over a
    128th of the chirp at its start: 1e-4 of the largest sample.
    """
    paths = some_paths(16, chirp_span_m(SMALL, OVERLAP), two_ways=two_ways, speed_mps=20.0)
    got = samples_of(echo_terms(SMALL, paths, effects, FAULTS, BEAM, "float32"))
    assert error_over_largest(got, literal_echoes(SMALL, paths, effects, FAULTS, BEAM, range(4))) < 1e-4


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
    assert echo_terms(setup, paths, PLAIN, FAULTS, BEAM, "float32")[0].dtype == np.complex64


def test_the_last_chirps_echo_counts_where_it_passes_the_low_pass() -> None:
    """A band of half the rate: at 13 % of the chirp the last chirp's tone lies 0.43 of the rate off, under 1/2.

    With twice the band it lies beyond and is gone; in both the compiled sum has what the reference has.
    """
    for bandwidth_hz in (0.5 * SMALL.radar.sample_rate_hz, SMALL.radar.sample_rate_hz):
        setup = RadarSetup(radar=msgspec.structs.replace(SMALL.radar, bandwidth_hz=bandwidth_hz))
        paths = some_paths(20, chirp_span_m(setup, OVERLAP))
        assert decimation(setup.radar, float(paths.length_m.max())) > 1
        assert largest_error(setup, paths, SignalEffects(chirp_overlap=True)) < 1e-4


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_full_band_is_summed_at_the_full_rate(precision: str) -> None:
    """Echoes over the whole band: no low rate holds them. Literal: 1e-4 and, but for slow time, 1e-9."""
    setup = RadarSetup(radar=msgspec.structs.replace(SMALL.radar, bandwidth_hz=SMALL.radar.sample_rate_hz))
    paths = some_paths(10, chirp_span_m(setup, 0.9))
    assert decimation(setup.radar, float(paths.length_m.max())) == 1
    got = samples_of(echo_terms(setup, paths, ALL, FAULTS, BEAM, precision))
    wanted = literal_echoes(setup, paths, ALL, FAULTS, BEAM, range(4))
    assert error_over_largest(got, wanted) < {"float32": 1e-4, "float64": 1e-9}[precision]


def in_groups(paths: Paths) -> list[tuple[Paths, SignalEffects]]:
    """Every pair of squint and overlap, for a quarter of the paths each."""
    effects = [
        msgspec.structs.replace(ALL, squint=squint, chirp_overlap=overlap)
        for squint in (True, False)
        for overlap in (True, False)
    ]
    return [(paths.take(np.arange(i, len(paths), 4)), one) for i, one in enumerate(effects)]


def test_groups_with_effects_of_their_own_add_up() -> None:
    """One sum of four groups against a sum of each, at rest: 1e-11."""
    paths = some_paths(40, chirp_span_m(SMALL, OVERLAP), speed_mps=20.0)
    groups = in_groups(paths)
    alone = [group_beats(SMALL, [group], FAULTS) for group in groups]
    assert apart(group_beats(SMALL, groups, FAULTS), np.sum(alone, axis=0)) < 1e-11


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_some_paths_overlap(share: float) -> None:
    """In motion, against the literal sum of both kinds: the tolerance of slow time."""
    paths = some_paths(40, chirp_span_m(SMALL, OVERLAP), speed_mps=20.0)
    overlaps = np.arange(len(paths)) % 10 < 10 * share
    steady = msgspec.structs.replace(ALL, chirp_overlap=False)
    kinds = ((paths.take(overlaps), ALL), (paths.take(~overlaps), steady))
    literal = sum(literal_echoes(SMALL, some, effects, FAULTS, BEAM, range(4)) for some, effects in kinds if len(some))
    for precision, most in (("float32", 1e-4), ("float64", 2e-5)):
        terms = echo_terms(SMALL, paths, ALL, FAULTS, BEAM, precision, overlaps)
        assert error_over_largest(samples_of(terms), literal) < most


@pytest.mark.parametrize("paths", [1, 40])
def test_beats_in_single_precision_miss_no_more_than_plans_allow(paths: int) -> None:
    """Full-size radar, in every range bin of every beam: a share of all echoes at the array's peak."""
    setup, some = RadarSetup(), some_paths(paths, 200.0)
    groups = in_groups(some) if paths > 4 else [(some, ALL)]
    single, double = (group_beats(setup, groups, FAULTS, precision=precision) for precision in TOLERANCE)
    missed = np.abs(hann_profiles(single - double, setup.radar.samples_per_chirp)).max()
    peak = setup.array.columns * setup.array.rows
    assert missed <= 0.5 * SINGLE * peak * np.abs(some.amplitude).sum()


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("effects", [PLAIN, ALL], ids=["plain", "all"])
def test_no_paths_are_silence(effects: SignalEffects, precision: str) -> None:
    beats, _, _ = echo_terms(SMALL, some_paths(0, 1.0), effects, FAULTS, BEAM, precision)
    assert beats.shape[1] == 512
    assert not beats.any()
    behind = one_path(3.0, 120.0, speed_mps=1.0)
    assert not echo_terms(SMALL, behind, effects, NO_FAULTS, BEAM, precision)[0].any()


def test_the_same_paths_give_the_same_bytes_with_any_number_of_threads() -> None:
    paths = some_paths(300, 200.0, speed_mps=20.0)
    setup = RadarSetup(radar=msgspec.structs.replace(RADAR, chirps_per_beam=4))
    made = []
    for threads in (1, 2, 2):
        with threadpool_limits(threads, "blas"):
            moving = [echo_terms(setup, paths, ALL, FAULTS, BEAM, kind)[0] for kind in ("float32", "float64")]
            made.append(b"".join(one.tobytes() for one in (*moving, group_beats(setup, [(paths, STATIC)], FAULTS))))
    assert made[0] == made[1] == made[2]
