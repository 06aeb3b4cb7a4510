from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from lab.networks.unet import FULL, UNet, UNetConfig
from lab.training.objectives.losses import heatmap_focal_loss

TINY = UNetConfig(range_bins=16, columns=8, widths=(4, 6, 8))
#: Squares of 2 x 2 cells as channels.
FOLDED = replace(TINY, patch=2)


def network(config: UNetConfig) -> UNet:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return UNet(config)


def test_published_widths_have_their_count() -> None:
    """3 channels in, 2 out, convolutions without bias before batch normalisation: 31,037,698 parameters."""
    with torch.device("meta"):
        assert sum(p.numel() for p in UNet(FULL).parameters()) == 31_037_698


def test_folded_cells_keep_their_place() -> None:
    """One resolution, two 3x3 convolutions over squares of 2 x 2: cell (9, 16) sees the squares within two of its own.

    That is square (4, 8), so rows 4..13 and columns 12..21, all of them and nothing else.
    """
    net = network(UNetConfig(range_bins=32, columns=32, patch=2, widths=(16,))).eval()
    x = torch.randn(1, 3, 32, 32, requires_grad=True)
    net(x)[0, 1, 9, 16].backward()
    assert x.grad is not None
    seen = x.grad[0].abs().sum(dim=0) > 0
    expected = torch.zeros(32, 32, dtype=torch.bool)
    expected[4:14, 12:22] = True
    assert torch.equal(seen, expected)


@pytest.mark.slow
@pytest.mark.parametrize("config", [TINY, FOLDED])
def test_learns_one_map(config: UNetConfig) -> None:
    """One map with one peak a class: the loss falls below a fifth, and the strongest cells are the peaks."""
    net = network(config)
    x = torch.randn(1, 3, 16, 8)
    heatmap = torch.zeros(1, 2, 16, 8)
    heatmap[0, 0, 5, 3] = heatmap[0, 1, 11, 6] = 1.0
    optimizer = torch.optim.Adam(net.parameters(), 2e-2)
    losses = []
    for _ in range(120):
        optimizer.zero_grad()
        loss = heatmap_focal_loss(net(x), heatmap)
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.2 * losses[0]
    assert net(x)[0].flatten(1).argmax(dim=1).tolist() == [5 * 8 + 3, 11 * 8 + 6]
