"""Hard numerical cases of training: confident logits, maps without peaks, half precision, borders, enormous maps."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from lab.training.data.samples import PointLabels
from lab.training.exported_weights import settle_norms
from lab.training.objectives.anchors import anchor_loss, anchor_targets
from lab.training.objectives.focal import binary_focal_loss
from lab.training.objectives.losses import heatmap_focal_loss
from models.perception.find.encoding import Encoding, encode_columns
from tests.stability.catalogue import Errors

ENCODING = Encoding(range_bins=8, columns=8)


def number(value: float) -> float:
    """The value, infinite where it is none."""
    return value if math.isfinite(value) else math.inf


@pytest.mark.parametrize("logit", [-1e4, 1e4])
@pytest.mark.hard("lab.training.objectives.losses", "log of the sigmoid", 1e-6, "",
                  "rounding to float32, relative to the loss |z|")  # fmt: skip
def test_focal_loss_of_sure_and_wrong(errors: Errors, logit: float) -> None:
    """A peak and a cell without one, both at z = +-1e4: the loss is 1e4, log sigmoid is -inf beyond 17 and -104."""
    logits = torch.full((1, 1, 2, 1), logit)
    heatmap = torch.tensor([1.0, 0.0]).reshape(1, 1, 2, 1)
    c = torch.sigmoid(logits)
    naive = -torch.where(heatmap == 1.0, (1.0 - c) ** 2 * torch.log(c), c**2 * torch.log(1.0 - c)).sum().item()
    ours = heatmap_focal_loss(logits, heatmap).item()
    errors(naive=number(abs(naive / abs(logit) - 1.0)), ours=abs(ours / abs(logit) - 1.0))


@pytest.mark.hard("lab.training.objectives.losses", "sigmoid clamped to 1e-6 .. 1 - 1e-6", 1e-6, "",
                  "rounding to float32")  # fmt: skip
def test_gradient_of_sure_and_wrong(errors: Errors) -> None:
    """A peak missed at z = -50: the gradient is -1, a clamp makes the loss flat and nothing is ever learnt again."""
    gradients = []
    for loss_of in (
        lambda z: -((1.0 - torch.sigmoid(z).clamp(1e-6, 1.0 - 1e-6)) ** 2 * torch.sigmoid(z).clamp(1e-6).log()).sum(),
        lambda z: heatmap_focal_loss(z, torch.ones(1)),
    ):
        logits = torch.full((1,), -50.0, requires_grad=True)
        loss_of(logits).backward()
        gradients.append(abs(logits.grad.item() + 1.0))
    errors(naive=gradients[0], ours=gradients[1])


def labels_of(row: list[float], column: list[float], path_class: int = 0) -> PointLabels:
    count = len(row)
    return PointLabels(
        row=np.array(row), column=np.array(column), path_class=np.full(count, path_class, np.uint8),
    )  # fmt: skip


@pytest.mark.hard("lab.training.objectives.anchors", "mean over the anchors of points", 1e-6, "",
                  "closed form, rounding to float32")  # fmt: skip
def test_anchors_of_an_empty_batch(errors: Errors) -> None:
    """No point in the whole batch: the mean over its anchors is 0 / 0, and offsets have nothing to be held against."""
    classes, offsets = anchor_targets([labels_of([], [])] * 2, (4, 4))
    output = torch.zeros(2, 5, 4, 4)
    exact = (2.0 / 3.0) ** 2 * math.log(3.0)
    focal = torch.full((2, 4, 4), exact)
    is_point = torch.from_numpy(classes) != 2
    naive = (focal[is_point].mean() + focal[~is_point].mean()).item()
    ours = anchor_loss(output, torch.from_numpy(classes), torch.from_numpy(offsets)).item()
    errors(naive=number(abs(naive / exact - 1.0)), ours=abs(ours / exact - 1.0))


@pytest.mark.hard("lab.training.objectives.anchors", "log of exp(z) / sum(exp(z))", 1e-6, "",
                  "rounding to float32, relative to the loss")  # fmt: skip
def test_anchor_sure_of_noise(errors: Errors) -> None:
    """One anchor of a point at z = (0, 0, 1e4): e^1e4 over itself; the loss is 1e4 and its gradient finite."""
    output = torch.zeros(1, 5, 1, 1)
    output[0, 2] = 1e4
    output.requires_grad_()
    loss = anchor_loss(output, torch.zeros(1, 1, 1, dtype=torch.int64), torch.zeros(1, 2, 1, 1))
    loss.backward()
    assert torch.isfinite(output.grad).all()
    weight = output.detach()[0, :3].exp()
    naive = -torch.log(weight[0] / weight.sum()).item()
    errors(naive=number(abs(naive / 1e4 - 1.0)), ours=abs(loss.item() / 1e4 - 1.0))


#: Focal loss in float64, Eq. (23).
def exact_focal(logits: torch.Tensor, heatmap: torch.Tensor) -> float:
    z, y = logits.double(), heatmap.double()
    at_peak = torch.sigmoid(-z) ** 2 * functional.softplus(-z)
    elsewhere = (1.0 - y) ** 4 * torch.sigmoid(z) ** 2 * functional.softplus(z)
    return torch.where(y == 1.0, at_peak, elsewhere).sum().item() / max(int((y == 1.0).sum()), 1)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16], ids=["float16", "bfloat16"])
@pytest.mark.hard("lab.training.objectives.losses", "the loss in the answer's own type", 1e-5, "",
                  "rounding of 1.6e5 terms summed in float32, relative to the loss")  # fmt: skip
def test_focal_loss_of_half_precision_answers(errors: Errors, dtype: torch.dtype) -> None:
    """Mixed precision, 320 x 256 x 2 cells at z = -9 and eight sure ones: squares of 1e-4 underflow or are rounded."""
    logits = torch.full((1, 2, 320, 256), -9.0)
    logits[0, 0, ::40, 7] = 3.3
    logits = (logits + 0.3 * torch.randn(logits.shape, generator=torch.Generator().manual_seed(0))).to(dtype)
    heatmap = torch.zeros(logits.shape)
    heatmap[0, 0, ::40, 7] = 1.0
    c, y = torch.sigmoid(logits), heatmap.to(dtype)
    naive = torch.where(y == 1.0, -((1.0 - c) ** 2) * torch.log(c), -((1.0 - y) ** 4) * c**2 * torch.log(1.0 - c))
    exact = exact_focal(logits, heatmap)
    ours = heatmap_focal_loss(logits, heatmap).item()
    errors(naive=number(abs(naive.sum().item() / 8 / exact - 1.0)), ours=abs(ours / exact - 1.0))


@pytest.mark.hard("lab.training.objectives.focal", "the loss in the answer's own type", 2e-6, "",
                  "an exponent of 16 rounded at 6e-8, and the product; relative to the loss")  # fmt: skip
def test_binary_focal_loss_of_half_precision_answers(errors: Errors) -> None:
    """Background at z = -8 in float16: (1 - alpha) p^2 is 1e-9, the least float16 6e-8."""
    logits, mask = torch.full((64,), -8.0, dtype=torch.float16), torch.zeros(64)
    p = torch.sigmoid(logits)
    naive = -(0.01 * p**2 * torch.log1p(-p)).mean().item()
    z = logits.double()
    exact = (0.01 * torch.sigmoid(z) ** 2 * functional.softplus(z)).mean().item()
    errors(naive=abs(naive / exact - 1.0), ours=abs(binary_focal_loss(logits, mask).item() / exact - 1.0))


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


def test_without_noise_levels_count_from_the_strongest_cell() -> None:
    encoding = Encoding(range_bins=8, columns=8, level_max_db=95.0, dynamic_range_db=90.0)
    encoded = encode_columns(encoding, hard_maps()["constant"], np.float64(0.0))
    np.testing.assert_allclose(encoded[0], (90 + 5) / 100, atol=1e-6)


@pytest.mark.hard("lab.training.exported_weights", "mean of squares less square of the mean, in the network's own type",
                  1e-3, "",
                  "rounding of values of 1e3 to float32 (3e-5 rms) beside a spread of 1e-2, relative to the "
                  "variance")  # fmt: skip
def test_variance_that_a_norm_sees_far_from_zero(errors: Errors) -> None:
    """A channel at 1000 that varies by 0.01: squares of 1e6 are rounded by 0.06, the variance is 1e-4."""
    x = 1e3 + 1e-2 * torch.randn(8, 1, 64, 64, generator=torch.Generator().manual_seed(0))
    norm = nn.BatchNorm2d(1)
    settle_norms(nn.Sequential(norm), x.split(2))
    exact = x.double().var(correction=0).item()
    naive = (x.square().mean() - x.mean() ** 2).item()
    assert norm.running_var is not None
    errors(naive=abs(naive / exact - 1.0), ours=abs(norm.running_var.item() / exact - 1.0))
