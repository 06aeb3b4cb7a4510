"""Hard numerical cases of the Swin-UNet: empty and enormous maps, half precision, logits far apart."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from lab.networks.swin_unet import SwinBlock, SwinUNet, SwinUNetConfig

#: Features of 16 x 8, 8 x 4, 4 x 2 and 2 x 1 cells under windows of 4: two stages clamp, one of them to one column.
SMALL = SwinUNetConfig(
    range_bins=64, columns=32, crop_columns=0, embed=8, depths=(2, 2, 2, 2), heads=(1, 2, 4, 8), window=(4, 4)
)


def network(**change: object) -> SwinUNet:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return SwinUNet(replace(SMALL, **change))  # type: ignore[arg-type]


def hard_maps() -> dict[str, Tensor]:
    noise = torch.randn(2, 3, 64, 32, generator=torch.Generator().manual_seed(0))
    one_cell = torch.zeros_like(noise)
    one_cell[:, :, 20, 10] = 1.0
    return {
        "zero": torch.zeros_like(noise),
        "constant": torch.full_like(noise, 1.0),
        "enormous": 1e6 * noise,
        "tiny": 1e-30 * noise,
        "one cell": one_cell,
    }


@pytest.mark.parametrize("head_hidden", [0, 16])
@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("name", hard_maps())
def test_logits_and_gradients_are_finite(name: str, bfloat16: bool, head_hidden: int) -> None:
    net = network(head_hidden=head_hidden).train()
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        logits = net(hard_maps()[name])
    logits.float().square().mean().backward()
    assert logits.shape == (2, 2, 64, 32)
    assert torch.isfinite(logits).all()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in net.parameters())


@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("scale", [1e2, 1e6])
def test_attention_with_enormous_logits_is_one_hot_and_stays_in_its_region(scale: float, bfloat16: bool) -> None:
    """Query and key weights times `scale`: the naive exponential is infinite, softmax picks the largest neighbour.

    Shifted windows of 4 x 4 on 16 x 8 cells: rows 0 and 1 came over the edge. A change there must not reach row 14,
    however strong its logits: a mask of -100 would let it through.
    """
    torch.manual_seed(0)
    block = SwinBlock(SMALL, 0, 1)
    with torch.no_grad():
        block.attn.qkv.weight[:16] *= scale
    x = torch.randn(1, 16, 8, 8)
    changed = x.clone()
    changed[:, :2] = 50.0 * torch.randn(1, 2, 8, 8)
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        before, after = block._attend(x), block._attend(changed)
    after.float().sum().backward()
    assert torch.isfinite(before).all()
    assert torch.isfinite(after).all()
    assert torch.isfinite(block.attn.qkv.weight.grad).all()
    assert torch.equal(before[:, 14:], after[:, 14:])
    assert not torch.equal(before[:, :2], after[:, :2])


def test_a_bias_that_dwarfs_the_logits_picks_its_offset() -> None:
    """A bias of 1e4 on no offset: every cell attends to itself alone, attention is value and projection."""
    torch.manual_seed(0)
    block = SwinBlock(SMALL, 0, 1)
    attn = block.attn
    nn.init.zeros_(attn.relative_position_bias_table)
    x = torch.randn(1, 16, 8, 8)
    with torch.no_grad():
        attn.relative_position_bias_table[24] = 1e4
        wanted = attn.proj(attn.qkv(x)[..., 16:])
        torch.testing.assert_close(block._attend(x), wanted, atol=1e-6, rtol=1e-5)
