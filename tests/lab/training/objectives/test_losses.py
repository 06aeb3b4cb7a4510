from __future__ import annotations

import pytest
import torch

from lab.training.objectives.heatmaps import gaussian_heatmap
from lab.training.objectives.losses import heatmap_focal_loss


def eq_23(logits: torch.Tensor, heatmap: torch.Tensor) -> torch.Tensor:
    """Eq. (23) as printed, on probabilities: exact while they are far from 0 and 1."""
    c = torch.sigmoid(logits)
    peak = (1 - c) ** 2 * torch.log(c)
    other = (1 - heatmap) ** 4 * c**2 * torch.log(1 - c)
    count = (heatmap == 1).sum()
    return -torch.where(heatmap == 1, peak, other).sum() / max(int(count), 1)


def example(points: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(points)
    rows, columns = torch.randint(0, 16, (2, points), generator=generator).double().numpy()
    heatmap = torch.from_numpy(gaussian_heatmap((16, 16), rows, columns)).double()[None, None]
    return 3.0 * torch.randn(1, 1, 16, 16, generator=generator, dtype=torch.float64), heatmap


@pytest.mark.parametrize("points", [0, 1, 5])
def test_equals_the_equation(points: int) -> None:
    logits, heatmap = example(points)
    torch.testing.assert_close(heatmap_focal_loss(logits, heatmap), eq_23(logits, heatmap), rtol=1e-12, atol=0.0)


def test_gradient_is_the_derivative() -> None:
    logits, heatmap = example(3)
    assert torch.autograd.gradcheck(lambda z: heatmap_focal_loss(z, heatmap), logits.requires_grad_())


def test_perfect_confidence_costs_nothing() -> None:
    _, heatmap = example(4)
    perfect = torch.where(heatmap == 1.0, 40.0, -40.0)
    assert heatmap_focal_loss(perfect, heatmap).item() == pytest.approx(0.0, abs=1e-12)


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match=r"heatmap's shape \(1, 2, 8, 8\), got \(1, 1, 8, 8\)"):
        heatmap_focal_loss(torch.zeros(1, 1, 8, 8), torch.zeros(1, 2, 8, 8))
