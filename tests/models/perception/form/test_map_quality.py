"""Checks of a scan's own hardware: each speaks of its fault and stays quiet about sound radars and other faults."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from models.perception.find.peaks import PeakParams, find_peaks
from models.perception.form.coarray import AzimuthInterpolator
from models.perception.form.map_quality import (
    ARRAY_LIMIT,
    array_deviation,
    has_spurs,
    interfered_beams,
    lost_chirps,
    silent_beams,
)
from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import ScanProfiles, form_map
from models.perception.mirrors.peaks_to_view import condition_flags
from models.physics.antenna import coarray_weights, setup_weights
from msgs.bus.codec import decode_inline, encode_inline
from msgs.values.radar import (
    PRESETS,
    WIRING_FAULTS,
    ArrayParams,
    BeamGrid,
    RadarParams,
    RadarSetup,
    RangeAzimuthGrid,
    RangeAzimuthMap,
)
from tests.builders import beam_of

SETUP = RadarSetup()
BEAMS, RANGES = 25, 96
NOISE_MW = 1e-9


def _profiles(seed: int = 0, columns: np.ndarray | None = None, level_db: float = 55.0) -> np.ndarray:
    """Beam profiles complex64 [beams, ranges] of a street: one to three echoes in each of many ranges, and noise."""
    rng = np.random.default_rng(seed)
    weights = setup_weights(SETUP) * (1.0 if columns is None else columns)
    to_beams = coarray_weights(weights).conj() / SETUP.array.columns**2
    position = np.arange(15) - 7
    coefficients = np.zeros((RANGES, 15), complex)
    for row in coefficients[8:]:
        for _ in range(rng.integers(1, 4)):
            amplitude = np.sqrt(NOISE_MW * 10 ** ((level_db + rng.normal(0.0, 5.0)) / 10.0))
            sine = np.sin(rng.uniform(-1.0, 1.0))
            row += amplitude * np.exp(2j * np.pi * rng.random()) * np.exp(-1j * np.pi * position * sine)
    noise = rng.standard_normal((BEAMS, RANGES, 2)) @ (1.0, 1.0j) * np.sqrt(NOISE_MW / 2.0)
    return (to_beams @ coefficients.T + noise).astype(np.complex64)


def _deviation(profiles: np.ndarray) -> float:
    matrix = AzimuthInterpolator(SETUP).coefficient_matrix
    assert matrix is not None
    return array_deviation(profiles.T @ matrix, NOISE_MW)


def _formed(profiles: np.ndarray, faults: tuple[str, ...] = ()) -> RangeAzimuthMap:
    grid = RangeAzimuthGrid(range_bin_m=SETUP.radar.range_bin_m, range_bins=RANGES)
    stamps_ns = np.arange(BEAMS, dtype=np.int64)
    scan = ScanProfiles(0, 0, profiles, NOISE_MW, stamps_ns, faults=faults)
    return form_map(scan, AzimuthInterpolator(SETUP, grid))


@pytest.mark.parametrize("seed", range(5))
def test_a_sound_radar_raises_nothing(seed: int) -> None:
    profiles = _profiles(seed)
    assert not silent_beams(profiles, NOISE_MW).any()
    assert not has_spurs(profiles, NOISE_MW)
    assert _deviation(profiles) < ARRAY_LIMIT
    assert _formed(profiles).faults == ()


def test_noise_alone_raises_nothing() -> None:
    profiles = _profiles(level_db=-60.0)
    assert not silent_beams(profiles, NOISE_MW).any()
    assert not has_spurs(profiles, NOISE_MW)
    assert _deviation(profiles) == 0.0


def test_a_lone_echo_has_nulls_that_are_no_silent_beams() -> None:
    """Boresight, 90 dB over the noise: beams at +-30 deg look with a null."""
    steering = np.exp(-1j * np.pi * (np.arange(15) - 7) * 0.0)
    row = coarray_weights(setup_weights(SETUP)).conj() @ steering / 64.0
    tall = np.sqrt(NOISE_MW * 1e9) * row[:, None] * np.hanning(40)
    assert not silent_beams(tall.astype(np.complex64), NOISE_MW).any()


@pytest.mark.parametrize("dead", [(0,), (3, 4, 20), tuple(range(0, 24, 2))])
def test_silent_beams_are_named(dead: tuple[int, ...]) -> None:
    profiles = _profiles(1)
    profiles[list(dead)] = _profiles(2, level_db=-60.0)[list(dead)]
    assert tuple(np.flatnonzero(silent_beams(profiles, NOISE_MW))) == dead


def test_an_interfered_beam_is_named_but_not_two_in_a_row() -> None:
    noise_mw = np.full(BEAMS, NOISE_MW)
    noise_mw[7] *= 10.0
    assert np.flatnonzero(interfered_beams(noise_mw)).tolist() == [7]
    # its neighbour must see in its place
    for beside in (10.0 * NOISE_MW, np.nan):
        noise_mw[8] = beside
        assert not interfered_beams(noise_mw).any()
    assert not interfered_beams(np.full(1, NOISE_MW)).any()


def test_interfered_beams_are_judged_by_the_median_of_all() -> None:
    """A beam counts from 6 dB, a ratio of 3.981, over the median beam, which holds the plain noise in both cases.

    Seven of 25 beams 30 dB up, none beside another: all seven are named. Judged by the mean they would lift the limit
    to 3.981 * (18 + 7000) / 25 = 1118 times the noise and go unseen. One beam at 4.2 times the noise is named, at 3.9
    times not; by the mean the limit would be 3.981 * (24 + 4.2) / 25 = 4.49.
    """
    several = [1, 4, 7, 10, 13, 16, 19]
    noise_mw = np.full(BEAMS, NOISE_MW)
    noise_mw[several] *= 1000.0
    assert np.flatnonzero(interfered_beams(noise_mw)).tolist() == several
    for ratio, named in ((4.2, [12]), (3.9, [])):
        noise_mw = np.full(BEAMS, NOISE_MW)
        noise_mw[12] *= ratio
        assert np.flatnonzero(interfered_beams(noise_mw)).tolist() == named


@pytest.mark.parametrize("level_db", [25.0, 45.0, 70.0])
def test_a_tone_in_every_beam_is_a_spur(level_db: float) -> None:
    profiles, rng = _profiles(3), np.random.default_rng(3)
    # a range without echoes; free-running: another phase in every beam
    profiles[:, 6] += np.sqrt(NOISE_MW * 10 ** (level_db / 10.0)) * np.exp(2j * np.pi * rng.random(BEAMS))
    assert has_spurs(profiles, NOISE_MW)
    # leakage lies at nearly zero range and is no fault
    near = _profiles(3)
    near[:, 1] += 1.0
    assert not has_spurs(near, NOISE_MW)


@pytest.mark.parametrize("errors", ["gains of board 1", "phases"])
def test_columns_that_are_not_as_stated_deviate(errors: str) -> None:
    """Gains measured on a real board (0.61 .. 1), phases of 30 deg rms: found in the plain co-array."""
    board = np.array([0.638, 0.813, 0.790, 0.974, 0.770, 0.800, 0.614, 1.0])
    phases = np.exp(1j * np.radians(30.0) * np.random.default_rng(5).standard_normal(8))
    profiles = _profiles(4, board if errors == "gains of board 1" else phases)
    assert _deviation(profiles) > ARRAY_LIMIT
    assert _formed(profiles).faults == ("array_error",)


def test_deviation_grows_with_the_error() -> None:
    draw = np.random.default_rng(6).standard_normal(8)
    deviations = [_deviation(_profiles(4, np.exp(1j * np.radians(rms) * draw))) for rms in (0.0, 15.0, 30.0, 60.0)]
    assert deviations == sorted(deviations)


@pytest.mark.parametrize(
    ("setup", "speaks"),
    [
        (PRESETS["xband"], True),
        (RadarSetup(beams=BeamGrid(azimuth_deg=tuple(np.linspace(-30.0, 30.0, 25).tolist()))), False),
        (RadarSetup(beams=BeamGrid(azimuth_deg=tuple(np.linspace(-50.0, 50.0, 25).tolist()))), False),
        # phases of 0 and 180 degrees: left and right are one
        (RadarSetup(array=ArrayParams(phase_bits=1)), False),
    ],
)
def test_beams_too_much_alike_say_nothing_of_their_array(setup: RadarSetup, speaks: bool) -> None:
    assert (AzimuthInterpolator(setup).coefficient_matrix is not None) == speaks


def test_a_turn_of_the_whole_beam_is_no_deviation() -> None:
    """A common phase, a common gain and a linear phase are another pointing, not another array."""
    columns = 0.5 * np.exp(1j * (0.3 + 0.2 * np.arange(8)))
    assert _deviation(_profiles(4, columns)) < ARRAY_LIMIT


def test_lost_chirps_are_zeros_through_and_through() -> None:
    samples = np.random.default_rng(7).integers(-3, 4, (16, 2048, 2)).astype(np.int16)
    assert lost_chirps(samples) == 0
    samples[[2, 9]] = 0
    assert lost_chirps(samples) == 2
    assert lost_chirps(np.zeros((3, 5, 2), np.int16)) == 3


def test_faults_reach_the_view_and_old_maps_still_decode() -> None:
    ra_map = _formed(_profiles(1), ("spurs",))
    assert ra_map.faults == ("spurs",)
    peaks = find_peaks(np.zeros((2, *ra_map.grid.shape)), ra_map, PeakParams())
    assert condition_flags(peaks) == ("spurs",)
    data = encode_inline(ra_map)
    assert decode_inline(RangeAzimuthMap, data).faults == ("spurs",)
    older = msgspec.msgpack.decode(data)
    del older["faults"]
    assert decode_inline(RangeAzimuthMap, msgspec.msgpack.encode(older)).faults == ()
    with pytest.raises(ValueError, match=r"map\.faults"):
        msgspec.structs.replace(ra_map, faults=("tired",)).__post_init__()


def _folded(samples_of: Callable[[int, np.random.Generator], np.ndarray]) -> RangeAzimuthMap:
    """The map of a short radar whose beams bring the samples of their index, float [8, 2048, 2]."""
    setup = RadarSetup(radar=RadarParams(samples_per_chirp=2048, sample_rate_hz=0.375e9, chirps_per_beam=8))
    former, rng = RaFormer(setup), np.random.default_rng(8)
    maps = []
    for index in range(len(setup.beams)):
        maps += former.add(beam_of(setup, index, np.rint(samples_of(index, rng)).astype(np.int16)))
    (only,) = maps
    return only


def test_chirps_that_a_link_loses_are_told() -> None:
    """Three chirps of one beam are zeros; of another beam everything."""

    def samples(index: int, rng: np.random.Generator) -> np.ndarray:
        noise = rng.normal(0.0, 20.0, (8, 2048, 2))
        noise[: {4: 3, 11: 8}.get(index, 0)] = 0.0
        return noise

    assert _folded(samples).faults == ("lost_chirps",)


def test_a_beam_under_foreign_noise_is_left_out() -> None:
    """20 dB over the others': the map is made of the rest, and says so."""
    formed = _folded(lambda index, rng: rng.normal(0.0, 200.0 if index == 18 else 20.0, (8, 2048, 2)))
    assert formed.faults == ("drowned_beams",)
    assert formed.missing_beams == (18,)
    assert formed.noise_power_mw < 2.0 * _folded(lambda _, rng: rng.normal(0.0, 20.0, (8, 2048, 2))).noise_power_mw


def test_a_tone_of_the_electronics_is_told() -> None:
    """A tone on bin 100, of another phase in every beam."""

    def samples(index: int, rng: np.random.Generator) -> np.ndarray:
        turns = 100.0 / 2048.0 * np.arange(2048) + rng.random()
        tone = 50.0 * np.stack([np.cos(2.0 * np.pi * turns), np.sin(2.0 * np.pi * turns)], axis=-1)
        return rng.normal(0.0, 20.0, (8, 2048, 2)) + tone

    assert _folded(samples).faults == ("spurs",)


def _echoing(seed: int, chirps: int = 4, level: float = 60.0, noise: float = 8.0) -> np.ndarray:
    """Samples int16 [beams, chirps, samples, 2] of twenty echoes at positive frequencies, leakage, an offset, noise."""
    rng = np.random.default_rng(seed)
    turns = np.arange(1024) / 1024.0
    bins, phases = rng.uniform(20.0, 250.0, 20), rng.uniform(0.0, 1.0, (6, 20))
    beats = np.exp(2j * np.pi * (np.multiply.outer(turns, bins) + phases[:, None, :])).sum(axis=2)
    leakage = 40.0 * np.exp(2j * np.pi * (1.3 * turns + 0.1))
    mean = level * (beats + leakage) + 100.0 - 50.0j
    samples = mean[:, None] + noise * (rng.standard_normal((6, chirps, 1024, 2)) @ (1.0, 1.0j))
    return np.rint(np.stack([samples.real, samples.imag], axis=-1)).clip(-32768, 32767).astype(np.int16)


def _wired(samples: np.ndarray, beat_sign: int = 1) -> tuple[str, ...]:
    """Return the faults of the wiring in a map of such samples."""
    setup = RadarSetup(
        radar=RadarParams(chirps_per_beam=samples.shape[1], samples_per_chirp=1024),
        beams=BeamGrid(azimuth_deg=(-50.0, -30.0, -10.0, 10.0, 30.0, 50.0)),
        array=ArrayParams(columns=2),
        beat_sign=beat_sign,
    )
    former, maps = RaFormer(setup), []
    for index, codes in enumerate(samples):
        maps += former.add(beam_of(setup, index, codes, stamp_ns=index, full_scale_dbm=-20.0))
    (ra_map,) = maps
    return tuple(name for name in ra_map.faults if name in WIRING_FAULTS)


def _q(value: object) -> Callable[[np.ndarray], np.ndarray]:
    return lambda samples: np.stack([samples[..., 0], np.broadcast_to(value, samples[..., 0].shape)], -1)  # type: ignore[call-overload]


_SPOILED: dict[str, tuple[Callable[[np.ndarray], np.ndarray], tuple[str, ...]]] = {
    "exchanged": (lambda samples: samples[..., ::-1], ("iq_exchanged",)),
    "Q at zero": (_q(0), ("q_stuck",)),
    "Q at one code": (_q(-731), ("q_stuck",)),
    "Q with noise of its own": (_q(np.random.default_rng(0).integers(-1, 2, 1024)), ("q_stuck",)),
    "I at zero": (lambda samples: _q(0)(samples)[..., ::-1], ("i_stuck",)),
    "I = Q": (lambda samples: samples[..., [0, 0]], ("i_equals_q",)),
    "I = -Q": (lambda samples: samples[..., [0, 0]] * np.array([1, -1], np.int16), ("i_equals_q",)),
    "Q still in one beam": (lambda samples: np.stack([*samples[:5], _q(3)(samples[5])]), ("q_stuck",)),
    "both at zero": (np.zeros_like, ("i_stuck", "q_stuck")),
    "both at one code": (lambda samples: np.full_like(samples, 5), ("i_stuck", "q_stuck")),
    "bit 3 of I at one": (lambda samples: samples | np.array([8, 0], np.int16), ("i_bit_stuck",)),
    "bit 10 of Q at zero": (lambda samples: samples & np.array([-1, ~1024], np.int16), ("q_bit_stuck",)),
    "a bit of both": (lambda samples: samples | np.array([16, 64], np.int16), ("i_bit_stuck", "q_bit_stuck")),
}


@pytest.mark.parametrize("kind", _SPOILED)
def test_wrong_wiring_is_named(kind: str) -> None:
    spoil, faults = _SPOILED[kind]
    assert _wired(np.ascontiguousarray(spoil(_echoing(0)), dtype=np.int16)) == faults


@pytest.mark.parametrize(
    "samples",
    [
        _echoing(1),
        _echoing(2, level=0.0),
        _echoing(3, level=0.0, noise=0.6),
        # clipped hard: the harmonics of I and of Q stand on both sides
        _echoing(4, level=8000.0),
        # Q at half of I's gain, 20 degrees off: an image 9 dB down
        (_echoing(5) @ np.array([[1.0, 0.17], [0.0, 0.47]])).astype(np.int16),
        # a converter of 12 bits, at the top of 16 and at their bottom
        _echoing(6) & ~np.int16(15),
        _echoing(7) >> 4,
        # above zero alone, about no code that is a power of two
        _echoing(8, level=0.0) + np.int16(9000),
    ],
    ids=["echoes", "noise alone", "noise of a code", "saturated", "unbalanced", "high bits", "low bits", "offset"],
)
def test_a_sound_receiver_is_wired_well(samples: np.ndarray) -> None:
    assert _wired(samples) == ()
    # hardware whose beats have the other sign, and a set-up that says so
    assert _wired(np.ascontiguousarray(samples[..., ::-1]), beat_sign=-1) == ()
