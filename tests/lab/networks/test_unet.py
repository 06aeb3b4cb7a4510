from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from lab.networks.unet import COMPACT, FULL, UNet, UNetConfig
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


def test_compact_one_is_as_large_as_ours() -> None:
    """CompactUNet has 0.96 M parameters."""
    assert 0.9e6 < sum(p.numel() for p in UNet(COMPACT).parameters()) < 1.2e6


@pytest.mark.slow
@pytest.mark.parametrize("config", [FULL, COMPACT, replace(COMPACT, in_channels=5, range_bins=512)])
def test_answers_every_cell(config: UNetConfig) -> None:
    with torch.device("meta"):
        logits = UNet(config)(torch.empty(2, config.in_channels, config.range_bins, config.columns))
    assert logits.shape == (2, *config.output_shape) == (2, 2, config.range_bins, 256)


def test_maps_of_a_batch_do_not_mix() -> None:
    net = network(TINY).eval()
    x = torch.randn(3, 3, 16, 8)
    with torch.no_grad():
        torch.testing.assert_close(net(x)[1:2], net(x[1:2]), atol=1e-5, rtol=1e-4)


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


@pytest.mark.parametrize("config", [TINY, FOLDED])
def test_gradients_reach_every_parameter(config: UNetConfig) -> None:
    net = network(config)
    net(torch.randn(2, 3, 16, 8)).square().sum().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


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


@pytest.mark.parametrize("config", [TINY, FOLDED])
def test_onnx_agrees(config: UNetConfig, onnx_difference: Callable[..., float]) -> None:
    assert onnx_difference(network(config), torch.randn(1, 3, 16, 8)) < 1e-5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"range_bins": 500}, "multiples of 16, got 500 and 256"),
        ({"columns": 24}, "multiples of 16, got 512 and 24"),
        ({"range_bins": 336, "patch": 2}, "multiples of 32, got 336 and 256"),
    ],
)
def test_shapes_that_do_not_divide_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        UNetConfig(**change)
