"""The whole chain in single against double precision, one thread against two: `float64_chain` in short.

The field solver, whose kernels alone share their rows among threads, beside it.
"""

from __future__ import annotations

import numba
import numpy as np
import pytest

from benchmarks.perception.float64_chain import Answer, Comparison, DoubleChain, compare, double, single, view_bytes
from lab.evaluate.labelled_beams import LabelledPlace
from lab.full_wave.cpml import CpmlParams
from lab.full_wave.grid import Drive, GridParams, Media, YeeGrid
from models.perception.find.onnx_model import DensePredictor
from models.perception.form.ra_former import RaFormer
from msgs.values.radar import RadarBeam, RadarSetup

SEED, PLACES = 11, 2


def place(index: int) -> tuple[list[RadarBeam], RadarSetup]:
    """Beams of a random place with every effect it calls for."""
    drawn = LabelledPlace(SEED, index, "auto")
    return list(drawn.beams()), drawn.player.setup


@pytest.fixture(scope="module", params=range(PLACES))
def scan(request: pytest.FixtureRequest) -> tuple[list[RadarBeam], RadarSetup]:
    return place(request.param)


@pytest.fixture(scope="module")
def predictor() -> DensePredictor:
    return DensePredictor()


def compared(scan: tuple[list[RadarBeam], RadarSetup], predictor: DensePredictor) -> tuple[Comparison, Answer]:
    beams, setup = scan
    chain = DoubleChain(setup)
    one, ra_map = single(beams, setup, predictor)
    two = double(beams, chain, ra_map)
    return compare(0, one, two, chain.threshold), two


@pytest.mark.slow
def test_single_precision_moves_no_recovered_place(
    scan: tuple[list[RadarBeam], RadarSetup], predictor: DensePredictor
) -> None:
    """Same peaks, same places, none moved by a centimetre; the bound of the map is that of its transforms.

    A transform of 8192 samples rounds 13 times, a Doppler row of 8 and a co-array product of 25 add as roots of sums:
    some 20 roundings of the largest cell.
    """
    found, double_precision = compared(scan, predictor)
    assert len(double_precision.scan.recovered) > 0
    assert found.map_error <= 20.0 * np.finfo(np.float32).eps
    assert found.heatmap_error <= 1e-3
    assert found.peaks_alone == 0
    assert found.alone == []
    assert len(found.moved_m) == len(double_precision.scan.recovered)
    assert max(found.moved_m) <= 0.01


@pytest.mark.slow
def test_views_are_the_same_bytes_on_one_thread_and_on_two(scan: tuple[list[RadarBeam], RadarSetup]) -> None:
    """Network and kernels; and again, for what a thread leaves behind."""
    assert len({view_bytes(*scan, threads) for threads in (1, 2, 1)}) == 1


def test_double_chain_knows_what_is_missing(scan: tuple[list[RadarBeam], RadarSetup]) -> None:
    """The comparison would see a wrong map: a beam measured twice as strong moves its cells."""
    beams, setup = scan
    chain, former = DoubleChain(setup), RaFormer(setup)
    (stamps,) = [one for beam in beams for one in former.add(beam)]
    right = chain.map(beams, stamps).values
    wrong = chain.map([*beams[:12], beams[11], *beams[13:]], stamps).values
    assert np.abs(wrong - right).max() > 1e-2 * np.abs(right).max()


@pytest.mark.slow
@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one core")
def test_fields_are_the_same_bits_on_one_thread_and_on_two() -> None:
    """A lossy block in absorbing air, 600 steps: rows are shared out, sums are not."""
    before = numba.get_num_threads()
    try:
        runs = [fields(threads) for threads in (1, 2, 1)]
    finally:
        numba.set_num_threads(before)
    for run in runs[1:]:
        np.testing.assert_array_equal(run, runs[0])
    assert np.abs(runs[0]).max() > 0.0


def fields(threads: int) -> np.ndarray:
    numba.set_num_threads(threads)
    params = GridParams(96, 64, 2e-3, 10e9, absorber=CpmlParams(cells=12, leak=1e-6))
    media = np.ones((96, 64), np.complex128)
    media[40:60, 30:40] = 4.0 - 0.4j
    grid = YeeGrid(params, Media(out=media))
    profile = np.zeros(96, np.complex128)
    profile[45:50] = 1.0
    grid.run(Drive(22, profile, 6.0), (), 600, np.zeros((0, 96), np.complex128))
    return np.stack([grid.u[0].astype(np.float64)])
