from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from lab.networks.swin_unet import (
    COMPACT,
    NATIVE,
    TABLE_3,
    PatchExpand,
    PatchMerging,
    SwinBlock,
    SwinUNet,
    SwinUNetConfig,
    relative_position_index,
    shift_mask,
)

#: 64 x 64 cells: features of 16, 8, 4 and 2 cells a side, windows of 4, 4, 4 and 2.
SMALL = SwinUNetConfig(
    range_bins=64, columns=64, crop_columns=16, embed=8, depths=(2, 2, 2, 1), heads=(1, 2, 4, 8), window=(4, 4)
)


def network(config: SwinUNetConfig = SMALL) -> SwinUNet:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return SwinUNet(config).eval()


def without_values(config: SwinUNetConfig) -> SwinUNet:
    """The network with shapes and no numbers: the full sizes cost nothing."""
    with torch.device("meta"):
        return SwinUNet(config).eval()


@pytest.mark.slow
def test_rows_of_table_3() -> None:
    """Output size of every stage, [batch, rows, columns, channels]; the logits are cut to the 256 columns of a map."""
    net = without_values(TABLE_3)
    sizes: list[tuple[int, ...]] = []

    def note(_module: nn.Module, _inputs: tuple[Tensor, ...], output: Tensor) -> None:
        sizes.append(tuple(output.shape[1:]))

    for module in (net.patch_embed, *net.layers, *net.layers_up):
        module.register_forward_hook(note)
    logits = net(torch.empty(1, 3, 512, 512, device="meta"))
    assert sizes == [
        (128, 128, 96),
        (64, 64, 192),
        (32, 32, 384),
        (16, 16, 768),
        (16, 16, 768),
        (32, 32, 384),
        (64, 64, 192),
        (128, 128, 96),
        (128, 128, 96),
    ]
    assert logits.shape == (1, *TABLE_3.output_shape) == (1, 2, 512, 256)


@pytest.mark.slow
def test_native_takes_the_map_itself_with_the_same_parameters() -> None:
    net = without_values(NATIVE)
    assert net(torch.empty(1, 3, 512, 256, device="meta")).shape == (1, *NATIVE.output_shape) == (1, 2, 512, 256)
    shapes = {name: tensor.shape for name, tensor in net.state_dict().items()}
    assert shapes == {name: tensor.shape for name, tensor in without_values(TABLE_3).state_dict().items()}


def test_compact_is_small_and_its_bottleneck_sees_the_scene() -> None:
    net = network(COMPACT)
    assert 0.8e6 < sum(p.numel() for p in net.parameters()) < 1.1e6
    assert COMPACT.window_at(3) == COMPACT.size_at(3) == (10, 4)
    with torch.no_grad():
        logits = net(torch.zeros(1, 5, 320, 256))
    assert logits.shape == (1, *COMPACT.output_shape) == (1, 2, 320, 256)


@pytest.mark.slow
def test_windows_tile_or_shrink() -> None:
    """20 rows under a window of 8 take 5; where one window covers an axis nothing is shifted along it."""
    config = SwinUNetConfig(range_bins=320, columns=256, crop_columns=0, embed=32, heads=(2, 4, 8, 8))
    assert [config.window_at(stage) for stage in range(4)] == [(8, 8), (8, 8), (5, 8), (5, 8)]
    assert without_values(config)(torch.empty(1, 3, 320, 256, device="meta")).shape == (1, 2, 320, 256)
    assert SwinBlock(NATIVE, 3, 1).shift == (4, 0)
    assert SwinBlock(TABLE_3, 3, 1).shift == (4, 4)
    assert SwinBlock(TABLE_3, 3, 0).shift == (0, 0)


def test_position_index_counts_offsets_row_by_row() -> None:
    """Offset (d_row, d_column) of query minus key, each 1 - w .. w - 1, row-major: the order of published tables."""
    window = (3, 2)
    index = relative_position_index(window)
    cells = [(row, column) for row in range(3) for column in range(2)]
    for q, (q_row, q_column) in enumerate(cells):
        for k, (k_row, k_column) in enumerate(cells):
            assert index[q, k] == (q_row - k_row + 2) * 3 + (q_column - k_column + 1)


def test_shifted_windows_do_not_join_opposite_edges() -> None:
    """4 x 4 cells, windows 2 x 2, shift 1: only the last row and column of windows hold cells of both edges."""
    mask = shift_mask((4, 4), (2, 2), (1, 1))
    assert not mask[0].any()
    # cells (row, column) of a window: (0, 0), (0, 1), (1, 0), (1, 1)
    assert mask[1].int().tolist() == [[0, 1, 0, 1], [1, 0, 1, 0], [0, 1, 0, 1], [1, 0, 1, 0]]
    assert mask[2].int().tolist() == [[0, 0, 1, 1], [0, 0, 1, 1], [1, 1, 0, 0], [1, 1, 0, 0]]
    assert (mask[3] == ~torch.eye(4, dtype=torch.bool)).all()


def attention_by_definition(block: SwinBlock, x: Tensor) -> Tensor:
    """Shifted-window attention of one map [rows, columns, width], cell by cell, without windows or masks."""
    attn, (rows, columns), window, shift = block.attn, block.size, block.window, block.shift
    query, key, value = attn.qkv(x).reshape(rows, columns, 3, attn.heads, -1).unbind(2)
    answer = torch.empty_like(query)
    cells = [(row, column) for row in range(rows) for column in range(columns)]

    def home(row: int, column: int) -> tuple[int, int, bool, bool]:
        """Window of a cell after the roll, and whether the cell was carried over an edge."""
        tile = ((row - shift[0]) % rows // window[0], (column - shift[1]) % columns // window[1])
        return (*tile, row < shift[0], column < shift[1])

    for q in cells:
        near = [k for k in cells if home(*k) == home(*q)]
        offsets = [(q[0] - k[0] + window[0] - 1) * (2 * window[1] - 1) + q[1] - k[1] + window[1] - 1 for k in near]
        keys, values = (torch.stack([t[k] for k in near]) for t in (key, value))
        logits = (keys * query[q]).sum(-1) / query.shape[-1] ** 0.5 + attn.relative_position_bias_table[offsets]
        answer[q] = (torch.softmax(logits, dim=0)[..., None] * values).sum(0)
    return attn.proj(answer.flatten(2))


@pytest.mark.parametrize("block", [0, 1])
@pytest.mark.parametrize("window", [(4, 4), (2, 4), (8, 4), (4, 8)])
def test_window_attention_is_attention_in_windows(block: int, window: tuple[int, int]) -> None:
    """8 x 8 features of stage 1, 2 heads; against the sum written out, to 1e-5."""
    torch.manual_seed(1)
    layer = SwinBlock(replace(SMALL, window=window), 1, block)
    nn.init.normal_(layer.attn.relative_position_bias_table)
    nn.init.normal_(layer.attn.qkv.weight, std=0.5)
    x = torch.randn(1, 8, 8, 16)
    with torch.no_grad():
        torch.testing.assert_close(layer._attend(x)[0], attention_by_definition(layer, x[0]), atol=1e-5, rtol=1e-4)


def test_merging_takes_the_cells_of_a_patch_column_by_column() -> None:
    """Published order: (row, column) = (0, 0), (1, 0), (0, 1), (1, 1)."""
    merge = PatchMerging(1)
    merge.norm = nn.Identity()
    merge.reduction = nn.Identity()
    x = torch.arange(16.0).reshape(1, 4, 4, 1)
    assert merge(x)[0, 0, 1].tolist() == [2.0, 6.0, 3.0, 7.0]
    assert merge(x)[0, 1, 0].tolist() == [8.0, 12.0, 9.0, 13.0]


def test_expansion_lays_channels_out_row_by_row() -> None:
    """Published order: tile row, tile column, channel."""
    expand = PatchExpand(12, 2, (2, 3))
    expand.expand = nn.Identity()
    expand.norm = nn.Identity()
    x = torch.stack((torch.arange(12.0), 100 + torch.arange(12.0))).reshape(1, 1, 2, 12)
    out = expand(x)
    assert out.shape == (1, 2, 6, 2)
    assert out[0, 0, :, 0].tolist() == [0.0, 2.0, 4.0, 100.0, 102.0, 104.0]
    assert out[0, 1, :, 1].tolist() == [7.0, 9.0, 11.0, 107.0, 109.0, 111.0]


def test_cropped_logits_are_the_middle_of_the_whole() -> None:
    whole = network(replace(SMALL, crop_columns=0))
    cropped = network(SMALL)
    cropped.load_state_dict(whole.state_dict())
    x = torch.randn(1, 3, 64, 64)
    with torch.no_grad():
        torch.testing.assert_close(cropped(x), whole(x)[..., 16:48], atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("change", [{}, {"output_bias": True}, {"head_hidden": 16}])
def test_fresh_network_says_one_in_ten(change: dict[str, object]) -> None:
    """sigmoid(-2.19) = 0.1 on average in each class, also where Table 3 has no output bias."""
    net = network(replace(SMALL, **change))  # type: ignore[arg-type]
    with torch.no_grad():
        logits = net(torch.randn(2, 3, 64, 64))
    assert logits.mean(dim=(0, 2, 3)).tolist() == pytest.approx([-2.19, -2.19], abs=0.15)


def test_drop_path_grows_to_the_bottleneck() -> None:
    chances = [chance for stage in range(4) for chance in TABLE_3.drop_paths(stage)]
    assert chances == pytest.approx(list(np.linspace(0.0, 0.1, 12)))


def test_drop_path_keeps_the_mean_of_a_branch_and_rests_in_evaluation() -> None:
    """Bernoulli(0.5) over 4000 samples, each 0 or 2: mean 1 within 5 sigma = 0.08."""
    torch.manual_seed(0)
    block = SwinBlock(replace(SMALL, drop_path=0.5), 3, 0)
    branch = torch.ones(4000, 1, 1, 1)
    assert block.drop_path == 0.5
    dropped = block.train()._drop(branch)
    assert set(dropped.flatten().tolist()) == {0.0, 2.0}
    assert dropped.mean().item() == pytest.approx(1.0, abs=0.08)
    assert torch.equal(block.eval()._drop(branch), branch)


def test_same_seed_gives_the_same_network_and_the_same_training_step() -> None:
    def step() -> Tensor:
        net = network(replace(SMALL, drop_path=0.5)).train()
        torch.manual_seed(3)
        net(torch.ones(2, 3, 64, 64)).sum().backward()
        return torch.cat([p.grad.flatten() for p in net.parameters() if p.grad is not None])

    assert torch.equal(step(), step())
