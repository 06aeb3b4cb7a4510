from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from lab.training.data.samples import PointLabels
from lab.training.objectives.anchors import anchor_loss, anchor_targets
from lab.training.objectives.focal import binary_focal_loss
from models.perception.find.anchors import NOISE, anchor_points

LOS, MIRRORED = 0, 1
NO_POINTS = PointLabels(row=np.zeros(0), column=np.zeros(0), path_class=np.zeros(0, np.uint8))


def points(*at: tuple[float, float, int]) -> PointLabels:
    row, column, path_class = zip(*at, strict=True)
    return PointLabels(row=np.array(row), column=np.array(column), path_class=np.array(path_class, np.uint8))


def perfect_answer(classes: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """The answer [batch, 5, rows, columns] that says the targets with certainty."""
    logits = np.where(np.arange(NOISE + 1)[:, None, None] == classes[:, None], 20.0, -20.0)
    return np.concatenate([logits, offsets], axis=1).astype(np.float32)


def test_anchors_about_a_point_by_hand() -> None:
    """Stride 1, radius 1.5, LOS at (2.25, 3): distances to rows 1..3 are 1.25, 0.25, 0.75; sideways one cell.

    (1, 2) is sqrt(1.25^2 + 1) = 1.60 away, too far; (2, 2) 1.03 and (3, 2) 1.25 are within.
    """
    classes, offsets = anchor_targets([points((2.25, 3.0, LOS))], (6, 6))
    expected = np.full((6, 6), NOISE)
    expected[1, 3] = expected[2, 2:5] = expected[3, 2:5] = LOS
    np.testing.assert_array_equal(classes[0], expected)
    np.testing.assert_array_equal(offsets[0, :, 1, 3], [1.25, 0.0])
    np.testing.assert_array_equal(offsets[0, :, 3, 2], [-0.75, 1.0])
    assert (offsets[0, :, expected == NOISE] == 0.0).all()
    assert (classes.dtype, offsets.dtype) == (np.int64, np.float32)


def test_anchors_of_a_stride_by_hand() -> None:
    """Stride 2: anchors on 0.5, 2.5, 4.5, ...; the point (2.5, 4.0) has two within radius 2, at 1.5 and 0.5 cells."""
    classes, offsets = anchor_targets([points((2.5, 4.0, MIRRORED))], (4, 4), stride=2)
    expected = np.full((4, 4), NOISE)
    expected[1, 1:3] = MIRRORED  # columns 2.5 and 4.5; (0.5, 4.5) is 2.06 away
    np.testing.assert_array_equal(classes[0], expected)
    np.testing.assert_array_equal(offsets[0, :, 1, 1], [0.0, 1.5])
    np.testing.assert_array_equal(offsets[0, :, 1, 2], [0.0, -0.5])


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_nearest_point_wins(order: tuple[int, int]) -> None:
    """Points at rows 2 and 4.4: row 3 is nearer to the first (1 against 1.4), whatever their order."""
    both = [(2.0, 2.0, LOS), (4.4, 2.0, MIRRORED)]
    classes, offsets = anchor_targets([points(*(both[k] for k in order))], (8, 5))
    assert classes[0, :, 2].tolist() == [NOISE, LOS, LOS, LOS, MIRRORED, MIRRORED, NOISE, NOISE]
    assert offsets[0, 0, 3, 2] == -1.0


def test_first_of_equally_near_points_wins() -> None:
    classes, _ = anchor_targets([points((3.0, 3.0, MIRRORED), (3.0, 3.0, LOS))], (6, 6))
    assert (classes != LOS).all()


def test_each_map_has_its_own_points() -> None:
    classes, offsets = anchor_targets([NO_POINTS, points((1.0, 1.0, LOS)), NO_POINTS], (4, 4))
    assert (classes.shape, offsets.shape) == ((3, 4, 4), (3, 2, 4, 4))
    assert [(at != NOISE).any() for at in classes] == [False, True, False]


def test_points_off_the_map_are_left_out() -> None:
    """A map cropped in range keeps nothing of what lies behind; on its border, points keep the anchors they have."""
    off = points((8.2, 3.0, LOS), (3.0, -0.7, LOS), (500.0, 3.0, LOS), (-40.0, 3.0, MIRRORED))
    assert (anchor_targets([off], (8, 6))[0] == NOISE).all()
    assert anchor_targets([points((7.4, -0.4, LOS))], (8, 6))[0][0, 7, 0] == LOS


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_every_point_has_an_anchor(stride: int) -> None:
    """One point in each of 200 maps, anywhere: with the default radius none falls between the anchors."""
    at = np.random.default_rng(0).uniform(-0.49, 31.49, (200, 2))
    classes, _ = anchor_targets([points((row, column, LOS)) for row, column in at], (32 // stride,) * 2, stride)
    assert (classes == LOS).any(axis=(1, 2)).all()


@pytest.mark.parametrize("stride", [1, 2])
def test_decoding_inverts_the_targets(stride: int) -> None:
    """12 maps of 20 points at least 4 cells apart, as truth is: the same points come back within 1e-6 cells."""
    rng = np.random.default_rng(stride)
    truth = [apart(rng, 20, (64.0, 32.0)) for _ in range(12)]
    answer = perfect_answer(*anchor_targets(truth, (64 // stride, 32 // stride), stride))
    for one, output in zip(truth, answer, strict=True):
        found = anchor_points(output, stride, threshold=0.3, min_distance=3)
        wanted = np.array(sorted(zip(one.path_class, one.row, one.column, strict=True)))
        got = np.array(sorted(zip(found.path_class, *found.cells.T, strict=True)))
        np.testing.assert_allclose(got, wanted, rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(found.score, 1.0)


def apart(rng: np.random.Generator, count: int, shape: tuple[float, float]) -> PointLabels:
    """Points drawn one by one, each at least 4 cells from all others in row or column."""
    kept: list[np.ndarray] = []
    while len(kept) < count:
        drawn = rng.uniform(0.0, np.array(shape) - 1.0)
        if all(np.abs(drawn - other).max() >= 4.0 for other in kept):
            kept.append(drawn)
    row, column = np.array(kept).T
    return PointLabels(row=row, column=column, path_class=rng.integers(0, 2, count).astype(np.uint8))


def targets(*at: PointLabels) -> tuple[Tensor, Tensor]:
    classes, offsets = anchor_targets(at, (6, 6))
    return torch.from_numpy(classes), torch.from_numpy(offsets)


def test_loss_by_hand() -> None:
    """One anchor of 1 x 2 is LOS. Flat logits: p = 1/3, focal (2/3)^2 ln 3 both for it and for noise, mean each.

    Offsets 3 and 0.5 off: smooth l1 is 3 - 0.5 and 0.5^2 / 2.
    """
    classes = torch.tensor([[[LOS, NOISE]]])
    offsets = torch.tensor([[[[3.0, 0.0]], [[0.5, 0.0]]]])
    focal = (2.0 / 3.0) ** 2 * math.log(3.0)
    loss = anchor_loss(torch.zeros(1, 5, 1, 2), classes, offsets)
    assert loss.item() == pytest.approx(2.0 * focal + 2.5 + 0.125, rel=1e-6)


def test_offsets_of_noise_are_free() -> None:
    classes, offsets = targets(points((2.0, 2.0, LOS)))
    output = torch.zeros(1, 5, 6, 6)
    moved = output.clone()
    moved[:, 3:, 5, 5] = 7.0
    assert anchor_loss(moved, classes, offsets) == anchor_loss(output, classes, offsets)


def test_perfect_answer_costs_nothing() -> None:
    classes, offsets = targets(points((2.2, 2.7, LOS), (5.0, 1.0, MIRRORED)), NO_POINTS)
    answer = torch.from_numpy(perfect_answer(classes.numpy(), offsets.numpy()))
    assert anchor_loss(answer, classes, offsets).item() < 1e-12


@pytest.mark.parametrize("at", [NO_POINTS, points((2.0, 2.0, LOS))])
@pytest.mark.parametrize("scale", [1.0, 1e4, -1e4])
def test_loss_and_gradient_are_finite(at: PointLabels, scale: float) -> None:
    classes, offsets = targets(at)
    output = (scale * torch.randn(1, 5, 6, 6, generator=torch.Generator().manual_seed(0))).requires_grad_()
    loss = anchor_loss(output, classes, offsets)
    (gradient,) = torch.autograd.grad(loss, output)
    assert torch.isfinite(loss)
    assert torch.isfinite(gradient).all()


def test_targets_of_another_shape_are_refused() -> None:
    classes, offsets = targets(NO_POINTS)
    with pytest.raises(ValueError, match=r"classes must fit the output \(1, 5, 6, 5\), got \(1, 6, 6\)"):
        anchor_loss(torch.zeros(1, 5, 6, 5), classes, offsets)


@pytest.mark.parametrize("gamma", [0.0, 2.0])
def test_binary_focal_loss_equals_its_formula(gamma: float) -> None:
    """-alpha (1 - p)^gamma ln p on the mask, -(1 - alpha) p^gamma ln(1 - p) elsewhere, on probabilities."""
    generator = torch.Generator().manual_seed(0)
    logits = 3.0 * torch.randn(2, 2, 8, 8, generator=generator, dtype=torch.float64)
    mask = (torch.rand(2, 2, 8, 8, generator=generator) < 0.2).double()
    p = torch.sigmoid(logits)
    inside, outside = -0.9 * (1 - p) ** gamma * p.log(), -0.1 * p**gamma * (1 - p).log()
    wanted = torch.where(mask == 1, inside, outside).mean()
    torch.testing.assert_close(binary_focal_loss(logits, mask, 0.9, gamma), wanted, rtol=1e-10, atol=0.0)


@pytest.mark.parametrize("logit", [-1e4, -100.0, 0.0, 100.0, 1e4])
@pytest.mark.parametrize("truth", [0.0, 1.0])
def test_binary_focal_loss_is_finite(logit: float, truth: float) -> None:
    """At 1e4 on the wrong side the loss is alpha or 1 - alpha times 1e4, on the right side nothing."""
    logits = torch.full((1, 1, 2, 2), logit, requires_grad=True)
    loss = binary_focal_loss(logits, torch.full((1, 1, 2, 2), truth))
    (gradient,) = torch.autograd.grad(loss, logits)
    assert torch.isfinite(gradient).all()
    wrong = (0.99 if truth else 0.01) * max(0.0, -logit if truth else logit)
    if abs(logit) > 10.0:
        assert loss.item() == pytest.approx(wrong, rel=1e-5, abs=1e-12)


def test_binary_focal_loss_refuses_another_shape() -> None:
    with pytest.raises(ValueError, match=r"logits must have the mask's shape \(1, 2, 4, 4\), got \(1, 2, 4, 5\)"):
        binary_focal_loss(torch.zeros(1, 2, 4, 5), torch.zeros(1, 2, 4, 4))
