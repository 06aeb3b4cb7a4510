"""Hard numerical cases of the dense network: confident logits, empty and enormous maps."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from models.perception.encoding import Encoding, encode_columns
from models.training.losses import heatmap_focal_loss

ENCODING = Encoding(range_bins=8, columns=8)


@pytest.mark.parametrize("logit", [-1e4, -200.0, 200.0, 1e4])
def test_focal_loss_of_confident_logits(logit: float) -> None:
    """Where the network is sure and wrong the loss is |logit| a cell, and its gradient at most 1 a cell.

    Naive form: log of a float32 sigmoid is -inf from 104 on the negative side and from 17 on the positive one.
    """
    logits = torch.full((1, 1, 2, 1), logit, requires_grad=True)
    heatmap = torch.tensor([1.0, 0.0]).reshape(1, 1, 2, 1)
    loss = heatmap_focal_loss(logits, heatmap)
    loss.backward()
    assert loss.item() == pytest.approx(abs(logit), rel=1e-6)
    assert torch.isfinite(logits.grad).all()
    assert logits.grad.abs().max().item() == pytest.approx(1.0, abs=1e-6)
    naive = torch.log(torch.sigmoid(logits.detach())) + torch.log(1.0 - torch.sigmoid(logits.detach()))
    assert not torch.isfinite(naive).all()


def test_focal_loss_without_a_peak_is_the_sum_of_the_negatives() -> None:
    logits = torch.zeros(1, 1, 4, 4)
    # (1 - 0)^4 * 0.5^2 * log 2 a cell
    assert heatmap_focal_loss(logits, torch.zeros_like(logits)).item() == pytest.approx(16 * 0.25 * np.log(2), rel=1e-6)


def hard_maps() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    noise = (rng.standard_normal((8, 8)) + 1j * rng.standard_normal((8, 8))).astype(np.complex64)
    broken = noise.copy()
    broken[2, 3], broken[4, 5] = np.nan, np.inf
    return {
        "zero": np.zeros((8, 8), np.complex64),
        "constant": np.full((8, 8), 1.0 + 1.0j, np.complex64),
        "enormous": noise * np.float32(1e37),
        "tiny": noise * np.float32(1e-38),
        "one cell": np.where(np.arange(64).reshape(8, 8) == 20, noise, 0),
        "broken cells": broken,
    }


@pytest.mark.parametrize("name", hard_maps())
@pytest.mark.parametrize("noise_power_mw", [0.0, 1e-300, 1.0, 1e300, np.nan, np.inf])
def test_encoding_is_finite_and_bounded(name: str, noise_power_mw: float) -> None:
    encoded = encode_columns(ENCODING, hard_maps()[name], np.float64(noise_power_mw))
    assert np.isfinite(encoded).all()
    # levels, shadows 0..1; contrast -1..0; coordinates -1..1, to a rounding
    assert np.abs(encoded).max() <= 1.0 + 1e-6


def test_naive_level_of_an_enormous_map_overflows() -> None:
    """|z|^2 of 1e37 leaves float32 (3e38); ours squares in float64 and keeps the level."""
    values = hard_maps()["enormous"]
    with np.errstate(over="ignore"):
        assert not np.isfinite(np.abs(values) ** 2).all()
    ordinary = encode_columns(ENCODING, hard_maps()["constant"], np.float64(1e-3))
    scaled = encode_columns(ENCODING, hard_maps()["constant"] * np.float32(1e37), np.float64(1e71))
    np.testing.assert_allclose(scaled, ordinary, atol=1e-5)


def test_empty_map_is_level_zero_whatever_the_noise() -> None:
    for noise_power_mw in (0.0, 1.0):
        encoded = encode_columns(ENCODING, hard_maps()["zero"], np.float64(noise_power_mw))
        assert (encoded[:3] == 0.0).all()


def test_without_noise_levels_count_from_the_strongest_cell() -> None:
    encoding = Encoding(range_bins=8, columns=8, level_max_db=95.0, dynamic_range_db=90.0)
    encoded = encode_columns(encoding, hard_maps()["constant"], np.float64(0.0))
    np.testing.assert_allclose(encoded[0], (90 + 5) / 100, atol=1e-6)
