from __future__ import annotations

import torch

from lab.networks.unet import FULL, UNet, UNetConfig


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
