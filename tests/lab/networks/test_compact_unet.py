from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from lab.networks.compact_unet import CompactUNet, CompactUNetConfig, _fold_range, _shuffle
from models.perception.find.encoding import Encoding

SMALL = CompactUNetConfig(range_bins=32, columns=8, widths=(8, 12, 16), attention_heads=2)


def network(config: CompactUNetConfig = SMALL) -> CompactUNet:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return CompactUNet(config).eval()


def test_default_fits_the_encoding_and_the_grid() -> None:
    config = CompactUNetConfig()
    assert (config.in_channels, config.range_bins, config.columns) == Encoding().shape
    with torch.no_grad():
        logits = network(config)(torch.zeros(1, *Encoding().shape))
    assert logits.shape == (1, 2, 320, 256)


def test_fresh_network_says_one_in_ten_everywhere() -> None:
    """Head bias -2.19 is the logit of 0.1; head weights are small, so every cell starts near it."""
    with torch.no_grad():
        confidence = torch.sigmoid(network()(torch.zeros(1, 5, 32, 8)))
    assert confidence.mean().item() == pytest.approx(0.1, abs=0.02)


def test_fold_puts_pairs_of_bins_side_by_side() -> None:
    x = torch.arange(2 * 4 * 3).reshape(1, 2, 4, 3)
    folded = _fold_range(x)
    assert folded.shape == (1, 4, 2, 3)
    for channel in range(2):
        for half in range(2):
            assert torch.equal(folded[0, 2 * channel + half], x[0, channel, half::2])


def test_shuffle_puts_each_column_on_its_eight_outputs() -> None:
    """Output azimuth 8 j + k and range 2 i + h come from cell (i, j): what the encoding's columns are centred on."""
    classes, factor, rows, columns = 2, 8, 3, 4
    x = torch.zeros(1, classes * 2 * factor, rows, columns)
    x[0, :, 1, 2] = torch.arange(1.0, classes * 2 * factor + 1)
    shuffled = _shuffle(x, classes, factor)
    assert shuffled.shape == (1, classes, 6, 32)
    assert torch.equal(shuffled[0, :, 2:4, 16:24].reshape(-1), torch.arange(1.0, 33.0))
    assert shuffled.count_nonzero() == 32


@pytest.mark.parametrize("factor", [1, 2, 8])
def test_the_answer_has_the_stated_shape_and_columns(factor: int) -> None:
    """8 columns times the factor; the head's biases, 1 to 4 x factor, lie class by class, then bin, then azimuth."""
    net = network(replace(SMALL, azimuth_factor=factor))
    with torch.no_grad():
        nn.init.zeros_(net.head.weight)
        net.head.bias.copy_(torch.arange(1.0, 4 * factor + 1))
        answer = net(torch.zeros(1, 5, 32, 8))
    assert answer.shape == (1, *net.config.output_shape) == (1, 2, 32, 8 * factor)
    assert torch.equal(answer[0, :, 10:12, :factor].reshape(-1), torch.arange(1.0, 4 * factor + 1))
