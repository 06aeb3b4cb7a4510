"""Folding: integer sums are exact whatever the shape, the memory order or the values."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from models.perception.form.slow_time_sums import MAX_CHIRPS_PER_GROUP, fold_chirps, group_edges


def _codes(chirps: int, samples: int, seed: int = 7) -> np.ndarray:
    return np.random.default_rng(seed).integers(-32768, 32768, (chirps, samples, 2)).astype(np.int16)


def _expected(codes: np.ndarray, groups: int) -> np.ndarray:
    edges = [g * len(codes) // groups for g in range(groups + 1)]
    return np.stack([codes[a:b].astype(np.int64).sum(axis=0) for a, b in itertools.pairwise(edges)])


@pytest.mark.parametrize(
    ("chirps", "samples", "groups"), [(128, 64, 8), (1, 8, 1), (7, 5, 3), (16, 9000, 2), (9, 33, 9), (5, 1, 5)]
)
def test_sums_are_exact(chirps: int, samples: int, groups: int) -> None:
    codes = _codes(chirps, samples)
    sums, saturated = fold_chirps(codes, groups)
    assert sums.dtype == np.int32
    np.testing.assert_array_equal(sums, _expected(codes, groups))
    assert saturated == np.count_nonzero((np.abs(codes.astype(np.int32)) >= 32767).any(axis=-1))


def test_uneven_groups_hold_every_chirp_once() -> None:
    edges = group_edges(10, 4)
    assert edges.tolist() == [0, 2, 5, 7, 10]


def test_full_scale_is_counted_per_sample_at_both_rails() -> None:
    codes = np.zeros((6, 4, 2), np.int16)
    codes[0, 0] = [32767, -32768]
    codes[4, 1] = [0, -32767]
    codes[5, 2] = [32766, -32766]
    assert fold_chirps(codes, 1)[1] == 2


def test_read_only_strided_and_unaligned_arrays() -> None:
    codes = _codes(8, 16)
    read_only = np.frombuffer(codes.tobytes(), np.int16).reshape(codes.shape)
    strided = np.repeat(codes, 2, axis=1)[:, ::2]
    unaligned = np.frombuffer(b"\0" + codes.tobytes(), np.uint8)[1:].view(np.int16).reshape(codes.shape)
    want = fold_chirps(codes, 2)[0]
    for variant in (read_only, strided, unaligned):
        np.testing.assert_array_equal(fold_chirps(variant, 2)[0], want)


def test_the_longest_group_fits_its_32_bit_sums() -> None:
    codes = np.full((MAX_CHIRPS_PER_GROUP, 1, 2), -32768, np.int16)
    sums, saturated = fold_chirps(codes, 1)
    assert sums.tolist() == [[[-(2**31), -(2**31)]]]
    assert saturated == MAX_CHIRPS_PER_GROUP


@pytest.mark.parametrize(("chirps", "groups"), [(8, 0), (8, 9), (MAX_CHIRPS_PER_GROUP + 1, 1)])
def test_impossible_groups_are_refused(chirps: int, groups: int) -> None:
    with pytest.raises(ValueError, match="group"):
        group_edges(chirps, groups)


def test_other_types_are_refused() -> None:
    with pytest.raises(ValueError, match=r"samples must have dtype <i2, got <f4"):
        fold_chirps(np.zeros((2, 2, 2), np.float32), 1)
