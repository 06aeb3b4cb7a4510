"""Hard maps for the refinement: every answer finite, near its start, with a covariance that is one."""

from __future__ import annotations

import mpmath
import msgspec
import numpy as np
import pytest

from models.perception.find.detectors import NetworkDetector
from models.perception.find.refinement import EchoRefiner, RefinementParams, _sinc_slope
from models.perception.form.coarray import AzimuthInterpolator
from msgs.values.radar import BeamGrid, RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from tests.builders import example_map
from tests.stability.catalogue import Errors

SETUP = RadarSetup()
GRID = RangeAzimuthGrid()
REFINER = EchoRefiner(SETUP)


def ra_map(values: np.ndarray, noise_mw: float = 1e-13, grid: RangeAzimuthGrid = GRID) -> RangeAzimuthMap:
    return example_map(values, grid=grid, noise_power_mw=noise_mw)


def beam_noise(seed: int = 0, level: float = 1.0) -> np.ndarray:
    """A map of noise alone as beams make it."""
    rng = np.random.default_rng(seed)
    profiles = rng.standard_normal((2, len(SETUP.beams), GRID.range_bins)) * level
    beams = (profiles[0] + 1j * profiles[1]).astype(np.complex64)
    return AzimuthInterpolator(SETUP).interpolate(beams, np.inf)[0]


def check(values: np.ndarray, start: np.ndarray, noise_mw: float = 1e-13) -> None:
    found = REFINER.refine(ra_map(values, noise_mw), start)
    for array in (found.fractional, found.amplitude, found.covariance, found.misfit):
        assert np.isfinite(array).all()
    assert (np.linalg.eigvalsh(found.covariance[found.refined]) > 0.0).all()
    params = REFINER.params
    moved = np.abs(found.fractional - start)
    assert (moved <= params.most_priors * np.array([params.prior_bins, params.prior_cells]) + 1e-9).all()
    assert (found.fractional >= 0.0).all()
    assert (found.fractional <= np.array(GRID.shape) - 1.0).all()


def corners() -> np.ndarray:
    return np.array([[0, 0], [0, 255], [511, 0], [511, 255], [256, 0], [0, 128]], float)


@pytest.mark.parametrize("level", [1e-18, 1.0, 1e12])
def test_noise_alone_at_every_edge(level: float) -> None:
    check(beam_noise(level=level), corners())


def test_an_empty_map() -> None:
    check(np.zeros(GRID.shape), corners())


def test_no_noise_stated() -> None:
    check(beam_noise(), corners(), noise_mw=0.0)


@pytest.mark.hard(
    where="models.perception.find.refinement",
    naive="inverse of the Fisher information alone",
    bound=0.0,
    unit="echoes",
    source="information plus a prior is positive definite",
)
def test_covariance_of_echoes_in_one_place(errors: Errors) -> None:
    """Twenty starts on the same cell and twenty a hair apart: what tells them apart vanishes, its inverse does not."""
    apart = np.concatenate([np.zeros(20), 1e-9 * np.arange(40)])
    start = 100.0 + np.stack([apart, apart], axis=1)
    found = REFINER.refine(ra_map(beam_noise()), start)
    check(beam_noise(), start)
    # all places of a column of echoes by range alone: tone and slope of each
    tone, slope = REFINER.range_response(2.0 + apart[20:24])
    tangents = np.concatenate([tone, slope])
    information = np.real(tangents.conj() @ tangents.T)
    naive = sum(np.linalg.eigvalsh(information) <= 0.0)
    ours = sum((np.linalg.eigvalsh(found.covariance[found.refined]) <= 0.0).any(axis=1))
    errors(naive=naive, ours=ours)


@pytest.mark.hard(
    where="models.perception.find.refinement",
    naive="(cos(pi x) - sinc(x)) / x",
    bound=1e-11,
    unit="1/bin",
    source="next term of the series, pi^4 x^3 / 30, and rounding over 1e-4, at the change between the two",
)
def test_slope_of_a_tone_on_its_bin(errors: Errors) -> None:
    """Echoes 1e-9 to 1e-4 bins off a bin: the slope of sin(x) / x is a difference of two ones over nearly nothing."""
    offset = np.concatenate([10.0 ** np.arange(-12.0, -3.0), [0.99e-4, 1.01e-4]])
    with mpmath.workdps(50):
        exact = np.array([float(mpmath.diff(lambda x: mpmath.sincpi(x), mpmath.mpf(float(x)))) for x in offset])
    naive = (np.cos(np.pi * offset) - np.sinc(offset)) / offset
    errors(naive=np.abs(naive - exact).max(), ours=np.abs(_sinc_slope(offset) - exact).max())


def test_two_hundred_echoes_on_a_wall() -> None:
    check(beam_noise(), np.stack([np.linspace(50, 150, 200), np.linspace(40, 200, 200)], axis=1))


def test_more_echoes_than_allowed_leave_the_weakest_where_they_are() -> None:
    refiner = EchoRefiner(SETUP, RefinementParams(most_echoes=2))
    values = beam_noise()
    values[198:203] *= 1e-3
    found = refiner.refine(ra_map(values), np.array([[100.0, 100.0], [200.0, 50.0], [300.0, 60.0]]))
    assert not found.refined[1]


def test_no_echoes() -> None:
    assert len(REFINER.refine(ra_map(beam_noise()), np.zeros((0, 2))).refined) == 0


@pytest.mark.parametrize(
    "strange",
    [
        np.random.default_rng(1).standard_normal(GRID.shape),
        np.abs(beam_noise()),
    ],
    ids=["columns of any noise", "magnitudes said to be coherent"],
)
def test_a_map_that_no_beams_explain_stays(strange: np.ndarray) -> None:
    start = np.array([[100.0, 100.0], [300.0, 50.0]])
    found = REFINER.refine(ra_map(strange), start)
    assert not found.refined.any()
    np.testing.assert_array_equal(found.fractional, start)


@pytest.mark.parametrize("grid", [RangeAzimuthGrid(range_bin_m=0.1), RangeAzimuthGrid(range_bins=4)])
def test_a_map_of_other_bins_stays(grid: RangeAzimuthGrid) -> None:
    found = REFINER.refine(ra_map(np.ones(grid.shape), grid=grid), np.array([[2.0, 100.0]]))
    assert not found.refined.any()


def test_three_beams_in_a_row_missing_and_a_single_beam() -> None:
    """A gap in the scan; and an array of one beam, where azimuth rests on the start alone."""
    gap = msgspec.structs.replace(ra_map(beam_noise()), missing_beams=(10, 11, 12))
    assert np.isfinite(REFINER.refine(gap, corners()).covariance).all()
    single = EchoRefiner(RadarSetup(beams=BeamGrid(azimuth_deg=(0.0,))))
    found = single.refine(ra_map(np.ones(GRID.shape)), np.array([[100.0, 128.0]]))
    assert np.isfinite(found.fractional).all()
    assert np.isfinite(found.covariance).all()


def test_same_map_same_bytes_whatever_was_asked_before() -> None:
    start = np.array([[100.2, 100.0], [103.0, 90.0]])
    first = REFINER.refine(ra_map(beam_noise()), start)
    REFINER.refine(msgspec.structs.replace(ra_map(beam_noise(3)), missing_beams=(4,)), corners())
    again = EchoRefiner(SETUP, RefinementParams()).refine(ra_map(beam_noise()), start)
    assert first.fractional.tobytes() == again.fractional.tobytes()
    assert first.covariance.tobytes() == again.covariance.tobytes()


def test_an_unknown_way_to_refine_is_refused() -> None:
    with pytest.raises(ValueError, match=r"refine must be a bool or one of .*got 'sharper'"):
        NetworkDetector(SETUP, refine="sharper")  # type: ignore[arg-type]
