from __future__ import annotations

import numpy as np
import pytest

from models.perception.encoding import Encoding
from models.training.datasets import (
    BeamScan,
    DenseSample,
    Perturbation,
    PointLabels,
    augment,
    encode_batch,
    perturb_scan,
    shuffled_batches,
    split_scenes,
)
from msgs.radar import RangeAzimuthGrid

GRID = RangeAzimuthGrid(range_bins=32, azimuth_bins=64)
ENCODING = Encoding(range_bins=32, columns=8)


def labels(row: float, column: float) -> PointLabels:
    return PointLabels(row=np.array([row]), column=np.array([column]), path_class=np.array([1], np.uint8))


def sample(column: float = 20.0) -> DenseSample:
    columns = np.zeros((32, 8), np.complex64)
    columns[10, int(column) // 8] = 1.0
    return DenseSample(columns=columns, noise_power_mw=1e-3, labels=labels(10.0, column))


def test_split_is_fixed_disjoint_and_complete() -> None:
    train, validation = split_scenes(100, 0.15, seed=3)
    assert len(validation) == 15
    assert sorted([*train, *validation]) == list(range(100))
    np.testing.assert_array_equal(validation, split_scenes(100, 0.15, seed=3)[1])
    assert validation.tolist() != split_scenes(100, 0.15, seed=4)[1].tolist()


@pytest.mark.parametrize(("count", "share"), [(1, 0.5), (10, 0.0), (10, 1.0)])
def test_split_that_leaves_a_side_empty_is_refused(count: int, share: float) -> None:
    with pytest.raises(ValueError, match="validation_share must be in"):
        split_scenes(count, share, seed=0)


def test_flip_moves_map_and_truth_together() -> None:
    """The truth stays in the lit column, on the output cell that mirrors it."""
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(20):
        one = augment(sample(20.0), 64, rng)
        lit = int(np.flatnonzero(one.columns[10])[0])
        assert int(one.labels.column[0]) // 8 == lit
        seen.add(float(one.labels.column[0]))
    assert seen == {20.0, 43.0}


def test_perturbed_noise_is_as_strong_as_it_says() -> None:
    """Layout: an empty scan of 25 x 4096 bins. Added power is the stated noise less the original; the relative
    standard deviation of a mean over 102400 cells is 0.3 %. Tolerance: five of those.
    """
    scan = BeamScan(profiles=np.zeros((25, 4096), np.complex64), noise_power_mw=2.0, labels=labels(1, 1))
    noisy = perturb_scan(scan, Perturbation(), np.random.default_rng(1))
    added_mw = noisy.noise_power_mw - 2.0
    assert added_mw > 0.5
    assert np.mean(np.abs(noisy.profiles) ** 2) == pytest.approx(added_mw, rel=0.016)


def test_perturbation_changes_beams_not_ranges() -> None:
    """Without motion and added noise every beam keeps its profile up to one complex factor near 1.

    Gains and phases are normal: five standard deviations of 0.4 dB and 0.05 rad.
    """
    rng = np.random.default_rng(2)
    profiles = (rng.standard_normal((25, 64)) + 1j * rng.standard_normal((25, 64))).astype(np.complex64)
    scan = BeamScan(profiles=profiles, noise_power_mw=0.0, labels=labels(1, 1))
    factors = perturb_scan(scan, Perturbation(moving_share=0.0), rng).profiles / profiles
    np.testing.assert_allclose(factors, factors[:, :1] * np.ones(64), rtol=1e-5)
    assert np.abs(20 * np.log10(np.abs(factors))).max() < 2.0
    assert 0.0 < np.abs(np.angle(factors)).max() < 0.25


def test_motion_turns_the_phase_from_beam_to_beam_in_one_stretch_of_range() -> None:
    """Outside the stretch nothing turns; inside, neighbouring beams differ by one and the same phase, and magnitudes
    stay. Tolerance: complex64 rounding.
    """
    scan = BeamScan(profiles=np.ones((25, 64), np.complex64), noise_power_mw=0.0, labels=labels(1, 1))
    moved = Perturbation(gain_std_db=0.0, phase_std_rad=0.0, moving_share=1.0, missing_share=0.0)
    profiles = perturb_scan(scan, moved, np.random.default_rng(3)).profiles
    turn = profiles[1:] * profiles[:-1].conj()
    stretch = np.flatnonzero(np.abs(turn[0] - 1.0) > 1e-5)
    assert 0 < len(stretch) < 64
    assert (np.diff(stretch) == 1).all()
    np.testing.assert_allclose(turn[:, stretch], turn[0, stretch[0]], atol=1e-5)
    np.testing.assert_allclose(np.abs(profiles), 1.0, atol=1e-6)


def test_batch_shapes_and_peaks() -> None:
    inputs, heatmaps = encode_batch([sample(20.0), sample(33.0)], ENCODING, GRID)
    assert inputs.shape == (2, *ENCODING.shape)
    assert heatmaps.shape == (2, 2, 32, 64)
    assert heatmaps[0, 1, 10, 20] == heatmaps[1, 1, 10, 33] == 1.0


def test_epoch_visits_every_scene_once_and_repeats_with_its_seed() -> None:
    scenes = [[sample(float(column))] for column in range(0, 64, 8)]
    first = list(shuffled_batches(scenes, 4, ENCODING, GRID, seed=5))
    again = list(shuffled_batches(scenes, 4, ENCODING, GRID, seed=5))
    other = list(shuffled_batches(scenes, 4, ENCODING, GRID, seed=6))
    assert len(first) == 2
    for (inputs, heatmaps), (same_inputs, same_heatmaps) in zip(first, again, strict=True):
        np.testing.assert_array_equal(inputs, same_inputs)
        np.testing.assert_array_equal(heatmaps, same_heatmaps)
    assert any((a[0] != b[0]).any() for a, b in zip(first, other, strict=True))
